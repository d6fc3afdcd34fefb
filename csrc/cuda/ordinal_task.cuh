// A warp's task in composite_ordinal.cu: 4 lenses x 16 rows at one ordinal after another, from the cull to the sample.
#pragma once

#include "cuda/ordinal_operands.cuh"
#include "cuda/strip.cuh"

namespace lfgs::cuda {

#if __CUDA_ARCH__ >= 800
// The warp task, and what its lanes know of it.
template <bool Harmonics>
struct Task {
  const LensFrame& frame;
  Memory<Harmonics>& memory;
  WarpMemory<Harmonics>& own;
  int lane, row0, lens0;             // of the patch
  float middle_y;
  float x_sheared, half_x;           // of ordinal -1/2, x + tan y; half width to the outermost pixel centres
  float x_first;                     // x of ordinal -1/2 in the middle row
  unsigned places;                   // bit 8 p + s: the lens of sample s that this lane accumulates starts at place p

  __device__ Task(const LensFrame& frame_, Memory<Harmonics>& memory_, int tile_x, int tile_y)
      : frame(frame_), memory(memory_), own(memory_.warps[threadIdx.x / 32]), lane(threadIdx.x % 32) {
    const int warp = threadIdx.x / 32, across = warp % kWarpsAcross, down = warp / kWarpsAcross;
    const LensOptics& lens = frame.optics;
    row0 = tile_y * kTileRows + down * kWarpRows;
    lens0 = lens.ordinals.first_lens + (tile_x * kWarpsAcross + across) * kWarpLenses;
    middle_y = row0 + 0.5f * kWarpRows;
    const float phase0 = fmaf(lens0 + 0.5f * (kWarpLenses - 1), lens.line_number, -lens.origin);
    x_sheared = phase0 / 3 + 0.5f * lens.slant_tan + 1.f / 6;
    x_first = x_sheared - lens.slant_tan * middle_y;
    half_x = (0.5f * (kWarpLenses - 1) * lens.line_number + 0.5f) / 3 + 1.f / 3 + 0.01f;
    for (int h = 0; h < kHalves; ++h) {
      const int row = row0 + lane / kWarpLenses + 8 * h, number = lens0 + lane % kWarpLenses;
      const int start = lens_start(lens, row, number);
      own.start[h][lane] = start, own.length[h][lane] = lens_start(lens, row, number + 1) - start;
      own.phase[h][lane] = phase_at(lens, row, start);
    }
    __syncwarp();
    places = 0;
    for (int s = 0; s < 2 * kFragments; ++s)  // fragment s / 2, its row lane / 4 or 8 more
      places |= 1u << 8 * place_of(own.start[s / 4][s / 2 % 2 * 16 + s % 2 * 8 + lane / 4]) + s;
  }

  // x + tan y of an ordinal's samples, and of those of a group
  __device__ float sheared(float ordinal) const { return x_sheared + (ordinal + 0.5f) / 3; }

  __device__ Splat<float> staged(int i) const {
    return assembled(memory.splat[0][i], memory.splat[1][i], memory.splat[2][i]);
  }
  __device__ Strip strip(const Splat<float>& s) const {
    return Strip(s, row0 + 0.5f, row0 + kWarpRows - 0.5f, frame.optics.slant_tan);
  }

  // Which staged splats may touch the patch at which ordinal of the group; returns, in lane t, how many at ordinal t.
  __device__ int cull(int count, int first, int last) {
    const Ordinals& ordinals = frame.optics.ordinals;
    const float a = ordinals.centre[first], b = ordinals.centre[last];
    const float reach = fmaxf(fabsf(b - a) * 0.5f + ordinals.half[first], fabsf(b - a) * 0.5f + ordinals.half[last]);
    const unsigned before = (1u << lane) - 1;
    const float x = sheared(0.5f * (first + last)), half = half_x + (last - first) * (1.f / 6);
    uint16_t* queue = reinterpret_cast<uint16_t*>(own.operands);
    int survivors = 0, first_page = 0;
    for (int begin = 0; begin < count; begin += 32) {
      const int i = min(begin + lane, count - 1);
      const Splat<float> splat = staged(i);
      const Strip rows = strip(splat);
      const bool hit = (begin + lane < count) & rows.at(splat, 0.5f * (a + b), reach).touches(x, half);
      const unsigned hits = __ballot_sync(~0u, hit);
      if (hit) queue[survivors + __popc(hits & before)] = uint16_t(i);
      survivors += __popc(hits);
      if (begin < kPage) first_page = survivors;
    }
    __syncwarp();
    const float x_first_ordinal = sheared(first);
    int counts[kGroupOrdinals] = {}, mine = 0;
#pragma unroll 1
    for (int page = 0, begin = 0; page * kPage < count; ++page) {
      const int end = page ? survivors : first_page;
#pragma unroll 1
      for (; begin < end; begin += 32) {
        const bool inside = begin + lane < end;
        const int i = queue[inside ? begin + lane : 0];
        const Splat<float> splat = staged(i);
        const Strip rows = strip(splat);
#pragma unroll
        for (int t = 0; t < kGroupOrdinals; ++t) {
          const int ordinal = min(first + t, last);
          const Span span = rows.at(splat, ordinals.centre[ordinal], ordinals.half[ordinal]);
          const bool hit = inside & (first + t <= last) & span.touches(x_first_ordinal + t * (1.f / 3), half_x);
          const unsigned hits = __ballot_sync(~0u, hit);
          if (hit) own.queue[t][counts[t] + __popc(hits & before)] = uint8_t(i);
          counts[t] += __popc(hits);
        }
      }
      begin = end;
#pragma unroll
      for (int t = 0; t < kGroupOrdinals; ++t) mine = lane == t ? counts[t] : mine;
      if (page == 0 && lane < kGroupOrdinals) own.first_page[lane] = mine;
    }
    __syncwarp();
    return mine;
  }

  // The staged splat at place k of the queue of ordinal t.
  __device__ int queued(int t, int k) const {
    const int i = own.queue[t][k];
    return k >= own.first_page[t] ? i + kPage : i;
  }

  // Features of the samples at an ordinal as operands of the tensor cores.
  __device__ void features(int ordinal, float x_centre, unsigned (&d)[kFragments][4], unsigned (&A)[kFragments][2]) {
    const LensOptics& lens = frame.optics;
    const unsigned base = unsigned(__cvta_generic_to_shared(own.operands));
    uint4 low[kHalves], high[kHalves], rows[kHalves];  // all before the first is stored: their latencies overlap
#pragma unroll
    for (int h = 0; h < kHalves; ++h) {
      const int pixel = int(floorf((own.start[h][lane] + ordinal + 0.5f) * (1.f / 3)));
      const float x = pixel + 0.5f - x_centre, y = lane / kWarpLenses + 8 * h + 0.5f - 0.5f * kWarpRows;
      // From its start no sub-pixel of a lens wraps
      const float camera = camera_of(lens, own.phase[h][lane] + lens.phase_x * uint64_t(ordinal));
      const float v = (camera - lens.ordinals.view[ordinal]) * lens.ordinals.view_unit;
      const float vv = v * v, rest = lens.continuous ? v - __half2float(__float2half_rn(v)) : vv;
      low[h] = make_uint4(kOnes, halves(x, x), halves(y, y), halves(v, v));
      high[h] = make_uint4(halves(x * v, y * v), halves(vv, y * vv), halves(x * vv, vv * v), halves(rest, y * v));
      // The last two have coefficients of zero: they are for the colours
      rows[h] = make_uint4(kOnes, halves(y, y), halves(y * y, y * y), Harmonics ? halves(v, vv) : 0);
    }
#pragma unroll
    for (int h = 0; h < kHalves; ++h) {
      __syncwarp();
      uint4* to = reinterpret_cast<uint4*>(own.operands + lane * kFeatureBytes);
      to[0] = low[h], to[1] = high[h], to[2] = rows[h];
      __syncwarp();
#pragma unroll
      for (int f = 0; f < 2; ++f) {
        const unsigned row = base + (16 * f + lane % 16) * kFeatureBytes;
        load_matrix(d[2 * h + f], row + lane / 16 * 16);
        load_matrix(A[2 * h + f], row + 32);
      }
    }
  }

  // The coefficients of d and of the exponent for one hit, about (x_centre, middle_y) and the offset centre; unit is
  // the offset that v = 1 stands for.
  __device__ void coefficients(const Splat<float>& s, float centre, float unit, float x_centre, uint4& low,
                               uint4& high, uint4& exponent) const {
    const float S = fmaf(centre, fmaf(centre, s.S2, s.S1), s.S0), r = fast_rsqrt(S), inverse = r * r;
    const float s1 = fmaf(2 * centre, s.S2, s.S1) * unit * inverse, s2 = s.S2 * unit * unit * inverse;
    const float p1 = -0.5f * s1, p2 = fmaf(0.375f * s1, s1, -0.5f * s2);
    const float Y = middle_y - s.v0, tilt = fmaf(centre, s.c1, s.c0);
    const float E = fmaf(-tilt, Y, fmaf(-centre, s.du, x_centre - s.u0)), sweep = unit * fmaf(s.c1, Y, s.du);
    const float turn = unit * s.c1;
    const float v = fmaf(p1, E, -sweep) * r, yv = fmaf(-p1, tilt, -turn) * r, vv = fmaf(p2, E, -p1 * sweep) * r;
    const float yvv = fmaf(-p2, tilt, -p1 * turn) * r, vvv = -p2 * sweep * r;
    // The second half of vv, or where v itself is not exact in half the coefficient of what is left of it
    const unsigned v_ = split(v), vv_ = split(vv), yv_ = split(yv);
    const unsigned rest = frame.optics.continuous ? v_ << 16 : vv_;
    low = make_uint4(split(E * r), halves(p1 * r, yv), split(r), halves(vv, yvv));
    high = make_uint4(split(-tilt * r), halves(p2 * r, vvv), v_, __byte_perm(rest, yv_, 0x7632));
    exponent = make_uint4(split(fmaf(-s.tau * Y, Y, s.log2_opacity)), split(-2 * s.tau * Y), split(-s.tau), 0);
  }

  // The colour of a staged splat, for all cameras; number kBatch is black.
  __device__ Colour colour(int i) const {
    Colour out;
    const float4 c = memory.colour[Harmonics ? 0 : i];
    out.value[0] = c.x, out.value[1] = c.y, out.value[2] = c.z;
    return out;
  }
  static __device__ Colour whole(const float4& c, const uint2& slopes) {
    Colour out;
    out.value[0] = c.x, out.value[1] = c.y, out.value[2] = c.z;
    out.slope[0] = as_half2(__float_as_uint(c.w)), out.slope[1] = as_half2(slopes.x), out.slope[2] = as_half2(slopes.y);
    return out;
  }
  // With harmonics: stores one in the warp's memory; reads it.
  __device__ void keep(int place, const float4& c, const uint2& slopes) {
    own.whole_colour[Harmonics ? place : 0] = c, own.whole_slope[Harmonics ? place : 0] = slopes;
  }
  __device__ Colour kept_colour(int place) const {
    return whole(own.whole_colour[Harmonics ? place : 0], own.whole_slope[Harmonics ? place : 0]);
  }

  // The samples, a bit each, of which this lane of a quad multiplies the colours: those of place `quad` at an ordinal.
  __device__ unsigned own_place(int ordinal) const {
    const int quad = lane % 4;
    return places >> 8 * (quad == 3 ? 3 : (quad + 3 - ordinal % 3) % 3);
  }
  // What belongs to the place of an accumulated sample; parts by the place that its lens starts at.
  template <class T>
  __device__ T pick(const T (&parts)[3], int sample) const {
    return places >> sample & 1 ? parts[0] : places >> (8 + sample) & 1 ? parts[1] : parts[2];
  }

  // v and v^2 of an accumulated sample, as halves; they stand in the last columns of its features.
  __device__ unsigned view_of(const unsigned (&features)[kFragments][2], int sample) const {
    return __shfl_sync(~0u, features[sample / 2][sample % 2], lane | 3);
  }

  // Adds the n hits at ordinal t of the group to the samples' state.
  __device__ void draw(int t, int n, int ordinal) {
    const int quad = lane % 4, row = lane / 4;
    const float x_centre = floorf(x_first + (ordinal + 0.5f) * (1.f / 3));
    unsigned d_features[kFragments][4], A_features[kFragments][2], colour_features[kFragments][4];
    features(ordinal, x_centre, d_features, A_features);
    const float centre = frame.optics.ordinals.centre[ordinal], unit = offset_unit(frame.optics);
    const unsigned mine = own_place(ordinal);
#pragma unroll
    for (int s = 0; s < 2 * kFragments; ++s) {
      const unsigned view = Harmonics ? view_of(A_features, s) : 0;
      colour_features[s / 2][s % 2] = mine >> s & 1 ? kOnes : 0;
      colour_features[s / 2][s % 2 + 2] = mine >> s & 1 ? view : 0;
    }

    float colours[2 * kFragments] = {}, transmittances[2 * kFragments];
#pragma unroll
    for (int s = 0; s < 2 * kFragments; ++s) transmittances[s] = 1;
    const int quarter = (n + 3) / 4;
    int begin = 0, hit = kBatch<Harmonics>, kept = hit;  // this lane's hit of 32; and of the 32 before. kBatch: none
    if (Harmonics) keep(32 + lane, make_float4(0, 0, 0, 0), make_uint2(0, 0));
    for (; begin < quarter; begin += 8) {
      // 32 hits, one a lane: 8 of each quarter, columns 2 q and 2 q + 1 of four batches
      const int q = lane % 8 / 2, j = begin + lane / 8 * 2 + lane % 2;
      const bool valid = j < min(quarter, n - q * quarter);
      const int i = queued(t, valid ? q * quarter + j : 0);
      const Splat<float> splat = staged(i);
      float4 c = make_float4(0, 0, 0, 0);
      uint2 slopes = make_uint2(0, 0);
      if (Harmonics && valid) {  // before anything else, and kept there by __syncwarp: they take a while
        const unsigned at = __float_as_uint(splat.depth) + t;
        c = reinterpret_cast<const float4*>(frame.ordinal_colours)[at];
        slopes = reinterpret_cast<const uint2*>(frame.ordinal_slopes)[at];
      }
      __syncwarp();
      bool limit = valid && splat.log2_opacity > float(kLog2MaxAlpha);
      uint4 low, high, exponent;
      coefficients(splat, centre, unit, x_centre, low, high, exponent);
      if (!valid) exponent = make_uint4(kNothing, 0, 0, 0);
      if constexpr (Harmonics) {
        const int turn = begin / 8 % 2 * 32;
        keep(turn + lane, c, slopes);
        __syncwarp();
        const Colour last = kept_colour((first_of_quarter() ? 32 - turn : turn) + lane_before());
        store_operands(low, high, exponent, whole(c, slopes), last);
      } else {
        kept = hit, hit = valid ? i : kBatch<Harmonics>;
        store_operands(low, high, exponent, colour(hit), colour(before(hit, kept)));
      }
      __syncwarp();
      limit = __any_sync(~0u, limit);
      const int batches = min(4, (quarter - begin + 1) / 2);
      auto batch = [&](int b, auto limited) {
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
          blend<Limit>(d[0], A[0], c[0], frame.cut, colours[2 * f], transmittances[2 * f]);
          blend<Limit>(d[2], A[2], c[2], frame.cut, colours[2 * f + 1], transmittances[2 * f + 1]);
          blend<Limit>(d[1], A[1], c[1], frame.cut, colours[2 * f], transmittances[2 * f]);
          blend<Limit>(d[3], A[3], c[3], frame.cut, colours[2 * f + 1], transmittances[2 * f + 1]);
        }
      };
      if (!limit) {
        batch(0, std::false_type{});
        if (batches > 1) {
          batch(1, std::false_type{});
          if (batches > 2) batch(2, std::false_type{});
          if (batches > 3) batch(3, std::false_type{});
        }
      } else {
#pragma unroll 1
        for (int b = 0; b < batches; ++b) batch(b, std::true_type{});
      }
    }
    if (quarter % 2 == 0) {
      const int j = quarter - 1 - (begin - 8), last = j / 2 * 8 + quad * 2 + j % 2;
      const Colour end = Harmonics ? kept_colour((begin / 8 - 1) % 2 * 32 + last) : colour(__shfl_sync(~0u, hit, last));
      close(end, ordinal % 3, A_features, colours, transmittances);
    }
    join(t, colours, transmittances);
  }

  // Which lane has the hit before this one's in its quarter: that of the column before, the first of the 32 the last of
  // the 32 before.
  __device__ bool first_of_quarter() const { return lane / 8 == 0 && lane % 2 == 0; }
  __device__ int lane_before() const { return lane % 2 ? lane - 1 : first_of_quarter() ? lane + 25 : lane - 7; }
  __device__ int before(int hit, int kept) const {
    const bool last = lane / 8 == 3 && lane % 2 == 1;
    return __shfl_sync(~0u, last ? kept : hit, lane_before());
  }

  // One hit's operands; its colour as the difference to the hit before it in its quarter.
  __device__ void store_operands(const uint4& low, const uint4& high, const uint4& exponent, const Colour& now,
                                 const Colour& before) {
    reinterpret_cast<uint4*>(own.operands)[lane] = low;
    reinterpret_cast<uint4*>(own.operands + kHighOffset)[lane] = high;
    reinterpret_cast<uint4*>(own.operands + kExponentOffset)[lane] = exponent;
    auto value = [&](int c) { return split(now.value[c] - before.value[c]); };
    auto slope = [&](int c) { return bits(__hsub2(now.slope[c], before.slope[c])); };
    own.colour[lane] = make_uint4(value(0), value(1), value(2), 0);
    if (Harmonics) own.slope[Harmonics ? lane : 0] = make_uint4(slope(0), slope(1), slope(2), 0);
  }

  // Takes the last colour of each quarter off again where no spare column did; last: of the quarter of this lane.
  __device__ void close(const Colour& last, int shift, const unsigned (&features)[kFragments][2],
                        float (&colours)[2 * kFragments], const float (&transmittances)[2 * kFragments]) {
    Colour end;  // by the place that a lens starts at
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
        const __half2 slope = pick(end.slope, s);
        const float v = __low2float(as_half2(view_of(features, s)));
        value += v * fmaf(v, __high2float(slope), __low2float(slope));
      }
      colours[s] = fmaf(-transmittances[s], value, colours[s]);
    }
  }

  // Joins the four quarters, nearest first, behind what the samples hold; each lane keeps two samples.
  __device__ void join(int t, const float (&colours)[2 * kFragments], const float (&transmittances)[2 * kFragments]) {
    const bool odd = lane & 1, upper = lane & 2;
    float colour[kFragments], transmittance[kFragments];
    auto over = [](bool mine_behind, float c, float other_c, float T, float other_T) {
      return mine_behind ? fmaf(other_T, c, other_c) : fmaf(T, other_c, c);
    };
#pragma unroll
    for (int i = 0; i < kFragments; ++i) {
      const int away = kFragments + i;
      const float c = __shfl_xor_sync(~0u, odd ? colours[i] : colours[away], 1);
      const float T = __shfl_xor_sync(~0u, odd ? transmittances[i] : transmittances[away], 1);
      const float own_c = odd ? colours[away] : colours[i], own_T = odd ? transmittances[away] : transmittances[i];
      colour[i] = over(odd, own_c, c, own_T, T), transmittance[i] = own_T * T;
    }
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

  // Where sample i of the two that this lane keeps stands: its half, its slot there.
  __device__ int2 place_of_kept(int i) const {
    const int quad = lane % 4, sample = quad % 2 * kFragments + quad / 2 * kHalves + i, fragment = sample / 2;
    return make_int2(fragment / 2, fragment % 2 * 16 + sample % 2 * 8 + lane / 4);
  }

  // Nothing drawn yet. Samples that the panel does not have are opaque: nobody works on them.
  __device__ void clear(int first) {
    const LensOptics& lens = frame.optics;
#pragma unroll
    for (int i = 0; i < kHalves; ++i) {
      const int2 place = place_of_kept(i);
      const int row = row0 + place.y / kWarpLenses + 8 * place.x, start = own.start[place.x][place.y];
      const int end = row < lens.height_px ? min(start + own.length[place.x][place.y], 3 * lens.width_px) : 0;
#pragma unroll
      for (int t = 0; t < kGroupOrdinals; ++t) {
        const int m = start + first + t;
        own.state[t * kHalves + i][lane] = make_float2(0, m >= 0 && m < end ? 1.f : 0.f);
      }
    }
    __syncwarp();
  }

  __device__ bool opaque(int t) const {
    bool all = true;
#pragma unroll
    for (int i = 0; i < kHalves; ++i) all = all & (own.state[t * kHalves + i][lane].y < frame.stop);
    return __all_sync(~0u, all);
  }
  __device__ bool all_opaque(int ordinals) const {
    bool all = true;
    for (int t = 0; t < ordinals; ++t) all = all && opaque(t);
    return all;
  }

  // Hands every finished sample of ordinals first .. last to put(row in the tile, sub-pixel from its first, value).
  template <class Put>
  __device__ void finish(int first, int last, const float4& background, const Put& put) {
    const int down = threadIdx.x / 32 / kWarpsAcross;
#pragma unroll
    for (int i = 0; i < kHalves; ++i) {
      const int2 kept = place_of_kept(i);
      const int row = down * kWarpRows + kept.y / kWarpLenses + 8 * kept.x;
      const int start = own.start[kept.x][kept.y], end = min(own.length[kept.x][kept.y] - 1, last);
      int place = place_of(start + first), at = start - memory.rows[row].x + first;
      for (int ordinal = first; ordinal <= end; ++ordinal, ++at) {
        const float2 state = own.state[(ordinal - first) * kHalves + i][lane];
        const float behind = place == 0 ? background.x : place == 1 ? background.y : background.z;
        put(row, at, fmaf(state.y, behind, state.x));
        place = place == 2 ? 0 : place + 1;
      }
    }
  }
};
#endif

}  // namespace lfgs::cuda
