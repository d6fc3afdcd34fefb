// A warp's task in composite_lens_column.cu: its patch at one lens column, from the intersections to the samples.
//
// It reads the staged splats and the queue of intersections that Patch::cull() wrote. The tensor cores multiply the
// features of the samples with the coefficients of the intersections. The result goes to the colours and transmittances
// in WarpMemory::state. composite_lens_column.cu has the formulas.
#pragma once

#include "cuda/frame/lens_column/lens_column_features.cuh"

namespace lfgs::cuda {

#if __CUDA_ARCH__ >= 800

// All 32 lanes of a warp call the functions below together, see Features.
template <class Layout, bool Compensated>
struct Task : Features<Layout, Compensated> {
  static constexpr bool Harmonics = Layout::kHarmonics;
  static constexpr int kBatch = Layout::kBatch;
  using Base = Features<Layout, Compensated>;
  using Base::Base, Base::frame, Base::memory, Base::own, Base::lane, Base::staged, Base::queued;
  using Base::colour_features_at, Base::complete, Base::features, Base::pick, Base::take_compensation;
  using Base::view_bits;

  // Where the block holds colours: the colour of staged splat i, the same for all cameras. Number kBatch is black.
  __device__ Colour colour(int i) const {
    Colour out;
    const float4 c = memory.colour[Layout::kHoldsColours ? i : 0];
    out.value[0] = c.x, out.value[1] = c.y, out.value[2] = c.z;
    return out;
  }
  // Elsewhere: a colour out of the two pieces in which DirectFrame stores it; without harmonics the second is nothing.
  static __device__ Colour whole(const float4& c, const uint2& slopes) {
    Colour out;
    out.value[0] = c.x, out.value[1] = c.y, out.value[2] = c.z;
    out.slope[0] = __float_as_uint(c.w), out.slope[1] = slopes.x, out.slope[2] = slopes.y;
    return out;
  }
  // Keep such a colour in the warp's memory, as the last of a quarter in a round. Read it again: the next intersection
  // takes the difference to it. Odd rounds have places of their own (turn 1).
  __device__ void keep(int turn, int quarter, const float4& c, const uint2& slopes) {
    own.last_colour[turn][Layout::kHoldsColours ? 0 : quarter] = c;
    if (Harmonics) own.last_slope[turn][Harmonics ? quarter : 0] = slopes;
  }
  __device__ Colour kept_colour(int turn, int quarter) const {
    return whole(own.last_colour[turn][Layout::kHoldsColours ? 0 : quarter],
                 Harmonics ? own.last_slope[turn][Harmonics ? quarter : 0] : make_uint2(0, 0));
  }
  // The colour that another lane of the warp has.
  static __device__ Colour of_lane(const Colour& own, int lane) {
    Colour out;
#pragma unroll
    for (int c = 0; c < 3; ++c) {
      out.value[c] = __shfl_sync(~0u, own.value[c], lane);
      if (Harmonics) out.slope[c] = __shfl_sync(~0u, own.slope[c], lane);
    }
    return out;
  }

  // Add the n intersections of the queue, those of lens column t of the pass, to the state of the samples. The
  // intersections are taken in four quarters at once, and a lane of each quad blends one quarter. Over is associative,
  // and join() puts the quarters together. In each round 8 intersections of every quarter become operands, one a lane.
  // Then come up to four batches of products, each of 8 intersections (two of every quarter) and all 64 samples.
  __device__ void draw(int t, int n, int lens_column) {
    const int quad = lane % 4, row = lane / 4;

    // Features of the samples
    const float x_centre = floorf(own.x_first + (lens_column + 0.5f) * (1.f / 3));
    unsigned d_features[kFragments][4], A_features[kFragments][2], colour_features[kFragments][4];
    features(lens_column, x_centre, d_features, A_features);
    const LensColumns& lens_columns = frame.optics.lens_columns;
    const float centre = lens_columns.centre[lens_column], unit = offset_unit(frame.optics);
    colour_features_at(lens_column, A_features, colour_features);

    // Nothing drawn in any quarter yet, and black before the first intersection
    float colours[2 * kFragments] = {}, transmittances[2 * kFragments];
#pragma unroll
    for (int s = 0; s < 2 * kFragments; ++s) transmittances[s] = 1;
    const int quarter = (n + 3) / 4;
    int begin = 0, intersection = kBatch,
        kept = intersection;  // this lane's intersection of this round, of the last; kBatch: none
    if (!Layout::kHoldsColours && lane < 4) keep(1, lane, make_float4(0, 0, 0, 0), make_uint2(0, 0));
    for (; begin < quarter; begin += 8) {
      // Read this lane's intersection: those of quarter q are in the columns 2 q and 2 q + 1 of the four batches
      const int q = lane % 8 / 2, j = begin + lane / 8 * 2 + lane % 2;
      const bool valid = j < min(quarter, n - q * quarter);
      const int i = queued(valid ? q * quarter + j : 0);
      const Splat<float> splat = staged(i);
      float4 c = make_float4(0, 0, 0, 0);
      uint2 slopes = make_uint2(0, 0);
      // Colours are asked for first, since they take a while; __syncwarp keeps them before the rest
      if constexpr (Harmonics) {
        const unsigned at = __float_as_uint(splat.depth) + lens_column;
        if (valid) c = reinterpret_cast<const float4*>(frame.lens_column_colours)[at];
        if (valid) slopes = reinterpret_cast<const uint2*>(frame.lens_column_slopes)[at];
      } else if constexpr (!Layout::kHoldsColours) {
        c = reinterpret_cast<const float4*>(frame.splats.colours)[memory.id[i]];
      }
      [[maybe_unused]] float2 compensation;
      if constexpr (Compensated)
        compensation = reinterpret_cast<const float2*>(
            frame.lens_column_compensations)[__float_as_uint(splat.depth) + lens_column];
      __syncwarp();

      // Make its operands, and test whether any of the 32 is opaque or may need the exact formulas
      const LensColumnShape shape(splat, centre, unit);
      Operands operands = Base::template coefficients<false>(splat, shape, centre, unit, x_centre);
      if constexpr (Compensated) take_compensation(operands, splat, compensation);
      const bool opaque = valid && splat.log2_opacity > float(kLog2MaxAlpha);
      bool special = __any_sync(~0u, opaque || (valid && shape.s2 > lens_columns.most_bend));
      if constexpr (Compensated) special = special || __any_sync(~0u, valid && not_fitted(compensation));
      if (!valid) operands.exponent = make_uint4(kNothing, 0, 0, 0);

      // Store them, the colour as the difference to the colour of the intersection before
      if constexpr (!Layout::kHoldsColours) {
        if (!Harmonics) {
          c = by_place(frame.optics, c);
          c = make_float4(valid ? c.x : 0, valid ? c.y : 0, valid ? c.z : 0, 0);
        }
        const int turn = begin / 8 % 2;
        const Colour now = whole(c, slopes);
        Colour last = of_lane(now, lane_before());
        if (first_of_quarter()) last = kept_colour(1 - turn, q);
        if (j - begin == min(7, quarter - 1 - begin)) keep(turn, q, c, slopes);
        store_operands(operands, now, last);
      } else {
        kept = intersection, intersection = valid ? i : kBatch;
        store_operands(operands, colour(intersection), colour(before(intersection, kept)));
      }

      // Replace the operands of exact intersections. This is rare: it starts from the splat once more, so that common
      // rounds keep no registers for it
      unsigned needs_exact = 0;  // a bit for each lane
      if (special) {
        const Splat<float> again = staged(i);
        const LensColumnShape varying(again, centre, unit);
        bool mine = valid && varying.parabola_error(lens_columns, again.log2_opacity) > kMostParabolaError;
        if constexpr (Compensated) mine = mine || (valid && not_fitted(compensation));
        needs_exact = __ballot_sync(~0u, mine);
        special = needs_exact || __any_sync(~0u, opaque);
        if (mine) store_exactly(Base::template coefficients<true>(again, varying, centre, unit, x_centre));
      }
      __syncwarp();

      // One batch: multiply, complete the exact ones, and blend two intersections at two samples of each fragment, the
      // nearer intersection first
      const int batches = min(4, (quarter - begin + 1) / 2);
      auto batch = [&](int b, auto limited, const auto&... completed) {
        const char* at = own.operands + quad / 2 * kHighOffset + (8 * b + row) * 16 + quad % 2 * 8;
        const uint2 d_b = *reinterpret_cast<const uint2*>(at);
        const int word = (8 * b + row) * 4 + quad;
        const unsigned A_b = reinterpret_cast<const unsigned*>(own.operands + kExponentOffset)[word];
        const unsigned c_b = reinterpret_cast<const unsigned*>(own.colour)[word];
        const unsigned s_b = Harmonics ? reinterpret_cast<const unsigned*>(own.slope)[word] : 0;
#pragma unroll
        for (int f = 0; f < kFragments; ++f) {
          float d[4], A[4], c[4];
          multiply(d, d_features[f], d_b.x, d_b.y);
          multiply(A, A_features[f], A_b);
          if (Harmonics) {
            multiply(c, colour_features[f], c_b, s_b);
          } else {
            const unsigned one_hot[2] = {colour_features[f][0], colour_features[f][1]};
            multiply(c, one_hot, c_b);
          }
          constexpr bool Limit = decltype(limited)::value;
          (completed(d, A, f), ...);
          blend<Limit>(d[0], A[0], c[0], frame.sample_cut, colours[2 * f], transmittances[2 * f]);
          blend<Limit>(d[2], A[2], c[2], frame.sample_cut, colours[2 * f + 1], transmittances[2 * f + 1]);
          blend<Limit>(d[1], A[1], c[1], frame.sample_cut, colours[2 * f], transmittances[2 * f]);
          blend<Limit>(d[3], A[3], c[3], frame.sample_cut, colours[2 * f + 1], transmittances[2 * f + 1]);
        }
      };

      // The batches of this round. Usually alpha needs no limit and no intersection is exact, and the loop is unrolled
      if (!special) {
        batch(0, std::false_type{});
        if (batches > 1) {
          batch(1, std::false_type{});
          if (batches > 2) batch(2, std::false_type{});
          if (batches > 3) batch(3, std::false_type{});
        }
      } else {
        LensColumnShape varying(staged(i), centre, unit);
        LensColumnCompensation varied = exact_compensation(i, varying, centre, unit);
        if (!(needs_exact >> lane & 1)) varying.s1 = varying.s2 = 0, varied = LensColumnCompensation();
#pragma unroll 1
        for (int b = 0; b < batches; ++b) {
          if (!(needs_exact >> 8 * b & 0xff)) {
            batch(b, std::true_type{});
            continue;
          }
          const int at = 8 * b + 2 * quad;
          float2 s[2];
          LensColumnCompensation compensations[2];
#pragma unroll
          for (int i = 0; i < 2; ++i) {
            s[i] = make_float2(__shfl_sync(~0u, varying.s1, at + i), __shfl_sync(~0u, varying.s2, at + i));
            if constexpr (Compensated) compensations[i] = varied.of_lane(at + i);
          }
          batch(b, std::true_type{},
                [&](float (&d)[4], float (&A)[4], int f) { complete(d, A, d_features, f, s, compensations); });
        }
      }
    }

    // Colours were added as differences, so the last of each quarter has to be taken off again. Where the number of
    // columns is odd the spare one, which is black, has done so
    if (quarter % 2 == 0) {
      const int j = quarter - 1 - (begin - 8), last = j / 2 * 8 + quad * 2 + j % 2;
      const Colour end =
          Layout::kHoldsColours ? colour(__shfl_sync(~0u, intersection, last)) : kept_colour((begin / 8 - 1) % 2, quad);
      close(end, lens_column % 3, A_features, colours, transmittances);
    }
    join(t, colours, transmittances);
  }

  // Which lane has the intersection before this lane's in the same quarter: the one a column before. Before the first
  // column of a round comes the last one of the round before, which before() and draw() look up in what was kept.
  __device__ bool first_of_quarter() const { return lane / 8 == 0 && lane % 2 == 0; }
  __device__ int lane_before() const { return lane % 2 ? lane - 1 : first_of_quarter() ? lane + 25 : lane - 7; }
  __device__ int before(int intersection, int kept) const {
    const bool last = lane / 8 == 3 && lane % 2 == 1;
    return __shfl_sync(~0u, last ? kept : intersection, lane_before());
  }

  // Whether a parabola is too coarse for an intersection's compensation: CompensationFit marks it by a NaN.
  __device__ static bool not_fitted(float2 compensation) { return !(compensation.x == compensation.x); }
  // Return the compensation of staged splat i as a function of v, without that approximation.
  __device__ LensColumnCompensation exact_compensation(int i, const LensColumnShape& shape, float centre,
                                                       float unit) const {
    if constexpr (!Compensated) return {};
    const unsigned id = __float_as_uint(staged(i).depth) / unsigned(frame.optics.lens_columns.columns());
    return LensColumnCompensation(frame.splats.compensations[id], shape, centre, unit);
  }

  // Store this lane's coefficients of d.
  __device__ void store_shape(const Operands& operands) {
    reinterpret_cast<uint4*>(own.operands)[lane] = operands.low;
    reinterpret_cast<uint4*>(own.operands + kHighOffset)[lane] = operands.high;
  }
  // Overwrite the coefficients of an exact intersection; with compensation also those of A, then without the
  // compensation.
  __device__ void store_exactly(const Operands& operands) {
    store_shape(operands);
    if constexpr (Compensated) reinterpret_cast<uint4*>(own.operands + kExponentOffset)[lane] = operands.exponent;
  }
  // Store all operands of this lane's intersection; the colour as the difference to the intersection before it in its
  // quarter.
  __device__ void store_operands(const Operands& operands, const Colour& now, const Colour& before) {
    store_shape(operands);
    reinterpret_cast<uint4*>(own.operands + kExponentOffset)[lane] = operands.exponent;
    auto value = [&](int c) { return split(now.value[c] - before.value[c]); };
    auto slope = [&](int c) { return bits(__hsub2(as_half2(now.slope[c]), as_half2(before.slope[c]))); };
    auto fine = [&](int a, int b) {
      return bits(__hsub2(fine_steps(now.slope[a], now.slope[b]), fine_steps(before.slope[a], before.slope[b])));
    };
    own.colour[lane] = make_uint4(value(0), value(1), value(2), Harmonics ? fine(0, 1) : 0);
    if (Harmonics) own.slope[Harmonics ? lane : 0] = make_uint4(slope(0), slope(1), slope(2), fine(2, 2));
  }

  // Take the last colour of this lane's quarter, `last`, off again, weighted by the light that the quarter lets
  // through.
  __device__ void close(const Colour& last, int shift, const unsigned (&features)[kFragments][2],
                        float (&colours)[2 * kFragments], const float (&transmittances)[2 * kFragments]) {
    Colour end;  // of a sample whose lens starts at place c
#pragma unroll
    for (int c = 0; c < 3; ++c) {
      const int place = c + shift >= 3 ? c + shift - 3 : c + shift;
      end.value[c] = at_place(last.value, place);
      if (Harmonics) end.slope[c] = at_place(last.slope, place);
    }
#pragma unroll
    for (int s = 0; s < 2 * kFragments; ++s) {
      float value = pick(end.value, s);
      if (Harmonics) {
        const unsigned word = pick(end.slope, s);
        const __half2 slope = as_half2(word);
        const float v = __low2float(as_half2(view_bits(features, s)));
        value += v * fmaf(v, __high2float(slope), fmaf(fine_steps(word), kFineStep, __low2float(slope)));
      }
      colours[s] = fmaf(-transmittances[s], value, colours[s]);
    }
  }

  // Join the four quarters, nearest first, and blend them behind the samples' state. The lanes of a quad exchange
  // their sums in two steps, first pairs of quarters, then the two halves. Each ends with two of the 8 samples.
  __device__ void join(int t, const float (&colours)[2 * kFragments], const float (&transmittances)[2 * kFragments]) {
    const bool odd = lane & 1, upper = lane & 2;
    float colour[kFragments], transmittance[kFragments];
    auto over = [](bool mine_behind, float c, float other_c, float T, float other_T) {
      return mine_behind ? fmaf(other_T, c, other_c) : fmaf(T, other_c, c);
    };

    // Quarters 0 and 1, and 2 and 3: each lane gives away four samples and takes four
#pragma unroll
    for (int i = 0; i < kFragments; ++i) {
      const int away = kFragments + i;
      const float c = __shfl_xor_sync(~0u, odd ? colours[i] : colours[away], 1);
      const float T = __shfl_xor_sync(~0u, odd ? transmittances[i] : transmittances[away], 1);
      const float own_c = odd ? colours[away] : colours[i], own_T = odd ? transmittances[away] : transmittances[i];
      colour[i] = over(odd, own_c, c, own_T, T), transmittance[i] = own_T * T;
    }

    // Join the front half of the intersections and the back half, and blend both behind the earlier ones
#pragma unroll
    for (int i = 0; i < kHalves; ++i) {
      const int away = kHalves + i;
      const float c = __shfl_xor_sync(~0u, upper ? colour[i] : colour[away], 2);
      const float T = __shfl_xor_sync(~0u, upper ? transmittance[i] : transmittance[away], 2);
      const float own_c = upper ? colour[away] : colour[i], own_T = upper ? transmittance[away] : transmittance[i];
      float2& state = own.state[t * kHalves + i][lane];
      state = make_float2(fmaf(state.y, over(upper, own_c, c, own_T, T), state.x), state.y * own_T * T);
    }
  }
};
#endif

}  // namespace lfgs::cuda
