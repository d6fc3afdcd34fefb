// The operands of the tensor cores for a warp's task (lens_column_task.cuh): features of the samples with coefficients
// of the intersections. composite_lens_column.cu has the formulas.
#pragma once

#include "cuda/frame/lens_column/lens_column_patch.cuh"
#include "cuda/frame/lens_column/lens_column_compensation.cuh"
#include "cuda/frame/root_series.cuh"

namespace lfgs::cuda {

#if __CUDA_ARCH__ >= 800

// A patch at one lens_column. All 32 lanes of a warp call the functions below together. Before the products a lane has
// one intersection (its coefficients) or two samples, one of each half of the patch (their features). After them it has
// eight samples at two intersections, as the tensor cores lay out a product.
template <class Layout, bool Compensated>
struct Features : Patch<Layout> {
  static constexpr bool Harmonics = Layout::kHarmonics;
  using Base = Patch<Layout>;
  using Base::Base, Base::frame, Base::own, Base::lane, Base::middle_y, Base::places, Base::row0;

  // The features of all samples at a lens column, as operands of the tensor cores: for d, and for the exponent's part
  // A. A lane computes the features of two samples, one in each half of the patch; then the warp exchanges them through
  // its memory.
  __device__ void features(int lens_column, float x_centre, unsigned (&d)[kFragments][4],
                           unsigned (&A)[kFragments][2]) {
    const LensOptics& lens = frame.optics;
    const unsigned base = unsigned(__cvta_generic_to_shared(own.operands));

    // Compute the features: both halves before the first is stored, so that their latencies overlap
    uint4 low[kHalves], high[kHalves], rows[kHalves];
#pragma unroll
    for (int h = 0; h < kHalves; ++h) {
      const int m = own.start[h][lane] + lens_column, row = row0 + lane / kWarpLenses + 8 * h;
      const int pixel = int(floorf((m + 0.5f) * (1.f / 3)));
      const float x = pixel + 0.5f - x_centre, y = lane / kWarpLenses + 8 * h + 0.5f - 0.5f * kWarpRows;
      // With cells a lens column may also lie before the start of the lens or behind its end. The clamp below keeps v
      // there within a half
      uint64_t phase = phase_at(lens, row, m);
      if (lens.has_cells) phase += cell_phase(lens, row, m);
      float v = (camera_offset(lens, phase) - lens.lens_columns.view[lens_column]) * lens.lens_columns.view_unit;
      if (lens.has_cells) v = fminf(fmaxf(v, -2.f), 2.f);
      const float vv = v * v, rest = lens.continuous ? v - __half2float(__float2half_rn(v)) : vv;
      low[h] = make_uint4(kOnes, halves(x, x), halves(y, y), halves(v, v));
      high[h] = make_uint4(halves(x * v, y * v), halves(vv, y * vv), halves(x * vv, vv * v), halves(rest, y * v));
      // Only with compensation A has coefficients for v and v^2. Otherwise these two hold the values for the colours,
      // see view_bits()
      rows[h] = make_uint4(kOnes, halves(y, y), halves(y * y, y * y), Harmonics || Compensated ? halves(v, vv) : 0);
    }

    // Exchange them: a half at a time is stored, and loaded in the layout that the tensor cores want
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

  // The coefficients of d and of A for one intersection. They belong to x and y from (x_centre, middle_y) and to the
  // offset centre + unit v. complete() multiplies the d of an exact intersection by the factor that depends on v.
  template <bool NeedsExact>
  __device__ Operands coefficients(const Splat<float>& s, const LensColumnShape& shape, float centre, float unit,
                                   float x_centre) const {
    const float r = shape.r, p2 = NeedsExact ? 0.f : shape.p2();
    // The cubic term is not left out: the line that is nearest to it over the lens column joins the linear one
    const float p1 = NeedsExact ? 0.f : fmaf(frame.optics.lens_columns.cubic, shape.p3(), shape.p1());
    // With x - m = E + x - tilt y - v (sweep + turn y), each of these is the coefficient of the power in its name
    const float Y = middle_y - s.v0, tilt = fmaf(centre, s.c1, s.c0);
    const float E = fmaf(-tilt, Y, fmaf(-centre, s.du, x_centre - s.u0)), sweep = unit * fmaf(s.c1, Y, s.du);
    const float turn = unit * s.c1;
    const float v = fmaf(p1, E, -sweep) * r, yv = fmaf(-p1, tilt, -turn) * r, vv = fmaf(p2, E, -p1 * sweep) * r;
    const float yvv = fmaf(-p2, tilt, -p1 * turn) * r, vvv = -p2 * sweep * r;

    // Large coefficients are the sum of two halves. One entry has two uses. Where every v is exact as a half, it holds
    // the second half of the coefficient vv. For continuous views it holds the coefficient of v's rounding error
    const unsigned v_ = split(v), vv_ = split(vv), yv_ = split(yv);
    const unsigned rest = frame.optics.continuous ? v_ << 16 : vv_;
    return {make_uint4(split(E * r), halves(p1 * r, yv), split(r), halves(vv, yvv)),
            make_uint4(split(-tilt * r), halves(p2 * r, vvv), v_, __byte_perm(rest, yv_, 0x7632)),
            make_uint4(split(fmaf(-s.tau * Y, Y, s.log2_opacity)), split(-2 * s.tau * Y), split(-s.tau), 0)};
  }
  // Put an intersection's compensation, as lens_column_compensations_kernel stored it, into the coefficients of A.
  __device__ void take_compensation(Operands& operands, const Splat<float>& s, float2 compensation) const {
    const float Y = middle_y - s.v0;
    operands.exponent.x = split(fmaf(-s.tau * Y, Y, s.log2_opacity) + compensation.x);
    operands.exponent.w = __float_as_uint(compensation.y);
  }

  // The samples of this lane, a bit each, that stand at a place of their pixel at a lens column; none for place 3.
  __device__ unsigned of_place(int place, int lens_column) const {
    return places >> 8 * (place == 3 ? 3 : (place + 3 - lens_column % 3) % 3);
  }
  // Choose for a sample that this lane accumulates: parts[p] is for samples whose lens starts at place p.
  template <class T>
  __device__ T pick(const T (&parts)[3], int sample) const {
    return places >> sample & 1 ? parts[0] : places >> (8 + sample) & 1 ? parts[1] : parts[2];
  }

  // v and v^2, as halves, of a sample that this lane accumulates. They are the last two features of A, and those are
  // with the last lane of the quad.
  __device__ unsigned view_bits(const unsigned (&features)[kFragments][2], int sample) const {
    return __shfl_sync(~0u, features[sample / 2][sample % 2], lane | 3);
  }

  // v of a sample that this lane accumulates in full: with continuous views it is the sum of two features of d.
  __device__ float exact_view(const unsigned (&features)[kFragments][4], int sample) const {
    const unsigned (&of_fragment)[4] = features[sample / 2];
    const float v = __low2float(as_half2(__shfl_sync(~0u, of_fragment[sample % 2], lane | 3)));
    if (!frame.optics.continuous) return v;
    return v + __low2float(as_half2(__shfl_sync(~0u, of_fragment[2 + sample % 2], lane | 3)));
  }

  // Complete exact intersections, sample by sample, for two intersections at two samples of a fragment. Multiply d by
  // (1 + s1 v + s2 v^2)^(-1/2), and add the compensation to A. s has s1 and s2 of the intersections. For an
  // intersection whose d is complete they are zero and its compensation is 1, so that nothing changes.
  __device__ void complete(float (&d)[4], [[maybe_unused]] float (&A)[4], const unsigned (&features)[kFragments][4],
                           int fragment, const float2 (&s)[2],
                           [[maybe_unused]] const LensColumnCompensation (&compensations)[2]) const {
#pragma unroll
    for (int sample = 0; sample < 2; ++sample) {
      const float v = exact_view(features, 2 * fragment + sample);
#pragma unroll
      for (int i = 0; i < 2; ++i) {
        const float factor = fast_rsqrt(fmaf(v, fmaf(v, s[i].y, s[i].x), 1.f));
        d[2 * sample + i] *= factor;
        if constexpr (Compensated) A[2 * sample + i] += compensations[i].log2_at(v, factor * factor);
      }
    }
  }

  // The factors of the colours of intersections. Each sample takes the colour of one place of its pixel, so all
  // other features are zero. In each quad, lanes 0 to 2 have the features for value, slope and bend at that place. Lane
  // 3 has those for the fine steps of all three slopes, see slope_and_bend().
  __device__ void colour_features_at(int lens_column, const unsigned (&A)[kFragments][2],
                                     unsigned (&out)[kFragments][4]) const {
    const int quad = lane % 4;
    const unsigned mine = of_place(quad, lens_column);
    if (!Harmonics) {
#pragma unroll
      for (int s = 0; s < 2 * kFragments; ++s) out[s / 2][s % 2] = mine >> s & 1 ? kOnes : 0;
      return;
    }
    const unsigned first = quad == 3 ? of_place(0, lens_column) : mine,
                   second = quad == 3 ? of_place(1, lens_column) : 0;
    const unsigned third = quad == 3 ? of_place(2, lens_column) : mine;
#pragma unroll
    for (int s = 0; s < 2 * kFragments; ++s) {
      const unsigned view = view_bits(A, s);
      const unsigned fine = bits(__hmul2(as_half2(view & 0xffff), __float2half2_rn(kFineStep)));
      const unsigned value = quad == 3 ? fine : kOnes, slope = quad == 3 ? fine : view;
      out[s / 2][s % 2] = first >> s & 1 ? value : second >> s & 1 ? fine << 16 : 0;
      out[s / 2][s % 2 + 2] = third >> s & 1 ? slope : 0;
    }
  }
};
#endif

}  // namespace lfgs::cuda
