// The samples of a lane in composite_pixel.cu in half precision, two in a word: the same sub-pixel of two neighbouring
// pixels. What is rounded, and why that is good enough:
//
// - What does not depend on s is summed in float, then rounded.
// - The terms of d cancel, so d is as coarse as the largest of them: Gaussians that sweep far are evaluated carefully.
// - Colours are summed in halves over up to 32 Gaussians only, then in float. Transmittances stay halves all the way:
//   rounding to nearest leaves them unbiased.
// - With a raised cut, alphas below 1/255 count, too, in the patches that a Gaussian reaches, unless it is faint.
// - An opaque Gaussian does not end a sample: what shows through 0.99 of it is less than 0.01.
//
// A GPU computes 2^x of halves one by one, at an eighth of the rate of other instructions. So one of three sub-pixels
// uses a polynomial instead.
#pragma once

#include "cuda/common/halves.cuh"
#include "cuda/frame/pixel/pixel_samples.cuh"

namespace lfgs::cuda {

// 2^x of both halves, by the special function unit.
__device__ inline __half2 fast_exp2(__half2 x) {
  unsigned y;
  asm("ex2.approx.f16x2 %0, %1;" : "=r"(y) : "r"(bits(x)));
  return as_half2(y);
}
// 2^x of both halves, x <= 0, as the fourth power of a cubic. It errs by up to 0.0007, and by 2^-10 of itself through
// rounding.
__device__ inline __half2 polynomial_exp2(__half2 x) {
  auto constant = [](float c) { return __float2half2_rn(c); };
  __half2 root = __hfma2(x, constant(5.4741e-4f), constant(1.41449e-2f));
  root = fma_or_zero(x, __hfma2(x, root, constant(1.72729e-1f)), constant(1.f));
  const __half2 square = __hmul2(root, root);
  return __hmul2(square, square);
}

// A lane's samples; every word has those of two neighbouring pixels. v is the offset in units of half_unit(), `sum` the
// colour of the intersections since the last flush().
template <class C>
struct HalfSamples {
  LanePixels<C::lane_rows> pixels;
  float colour[C::lane_rows][2][3];
  __half2 v[C::lane_rows][3], sum[C::lane_rows][3], transmittance[C::lane_rows][3];

  __device__ HalfSamples(const DirectFrame& frame, int left, int top) : pixels(left, top) {
    const float inverse = 1 / half_unit(frame.optics);
    float at[C::lane_rows][2][3];
    pixels.template for_each_offset<C::Cells>(
        frame.optics, [&](int r, int p, int k, float s) { at[r][p][k] = s * inverse, colour[r][p][k] = 0; });
    for_each([&](int r, int k) {
      auto seen = [&](int p) { return pixels.seen(frame.optics, r, p) ? 1.f : 0.f; };
      v[r][k] = __floats2half2_rn(at[r][0][k], at[r][1][k]);
      sum[r][k] = __float2half2_rn(0.f), transmittance[r][k] = __floats2half2_rn(seen(0), seen(1));
    });
  }

  // Call visit(r, k) for the pairs of samples.
  template <class Visit>
  __device__ static void for_each(const Visit& visit) {
#pragma unroll
    for (int r = 0; r < C::lane_rows; ++r)
#pragma unroll
      for (int k = 0; k < 3; ++k) visit(r, k);
  }

  // Whether all samples are done.
  __device__ bool opaque(float stop) const {
    bool all = true;
    for_each([&](int r, int k) {
      const __half2 T = transmittance[r][k];
      all = all && fmaxf(__low2float(T), __high2float(T)) < stop;
    });
    return all;
  }

  // The step of an intersection's colour at place k, seen from v, for both samples.
  struct Steps {
    __half2 red_green, blue_slope, slopes;

    __device__ explicit Steps(float4 f) : red_green(unpacked(f.x)), blue_slope(unpacked(f.y)), slopes(unpacked(f.z)) {}
    __device__ __half2 at(int k, __half2 v) const {
      const __half2 step = k == 0 ? __low2half2(red_green) : k == 1 ? __high2half2(red_green) : __low2half2(blue_slope);
      const __half2 slope = k == 0 ? __high2half2(blue_slope) : k == 1 ? __low2half2(slopes) : __high2half2(slopes);
      return C::Harmonics ? __hfma2(v, slope, step) : step;
    }
  };

  // Add intersection i, see put_halves() for the polynomial. Cut: whether exponents below `cut` draw nothing.
  template <bool Cut>
  __device__ void add(const Staged<C::Harmonics>& staged, int i, float cut) {
    const float4 f0 = staged.fit[0][i], f1 = staged.fit[1][i];
    const Steps steps(staged.fit[2][i]);
    const __half2 line = unpacked(f1.z), bend = unpacked(f1.w), c2 = __high2half2(bend);

    // The polynomials in s at the lane's first two pixels; from row to row they change by steps
    const __half2 x = __floats2half2_rn(pixels.x, pixels.x + 1);
    float t = fmaf(f1.y, pixels.y, f1.x), c0 = fmaf(f0.y, pixels.x, fmaf(f0.z, pixels.y, f0.x));
    __half2 c1 = __hfma2(__high2half2(line), x, __low2half2(line));
    c1 = __hfma2(__low2half2(bend), __float2half2_rn(pixels.y), c1);
#pragma unroll
    for (int r = 0; r < C::lane_rows; ++r) {
      const __half2 A = __float2half2_rn(fmaf(-t, t, f0.w)), pair = __floats2half2_rn(c0, c0 + f0.y);
#pragma unroll
      for (int k = 0; k < 3; ++k) {
        __half2& T = transmittance[r][k];
        const __half2 d = __hfma2(v[r][k], __hfma2(v[r][k], c2, c1), pair), power = __hfma2(__hneg2(d), d, A);
        __half2 alpha = k == 1 ? polynomial_exp2(power) : fast_exp2(power);
        if (Cut) alpha = as_half2(bits(alpha) & __hge2_mask(power, __float2half2_rn(cut)));
        sum[r][k] = __hfma2(T, steps.at(k, v[r][k]), sum[r][k]);
        T = __hfma2(__hneg2(alpha), T, T);
      }
      t = fmaf(4, f1.y, t), c0 = fmaf(4, f0.z, c0);
      c1 = __hfma2(__low2half2(bend), __float2half2_rn(4.f), c1);
    }
  }

  // Add the sums of colours to those in float. Called after every 32 intersections.
  __device__ void flush() {
    for_each([&](int r, int k) {
      colour[r][0][k] += __low2float(sum[r][k]), colour[r][1][k] += __high2float(sum[r][k]);
      sum[r][k] = __float2half2_rn(0.f);
    });
  }

  // Add only the step of exact intersection i, which takes the colour of the intersection before off again.
  __device__ void close(const Staged<C::Harmonics>& staged, int i) {
    const Steps steps(staged.fit[2][i]);
    for_each([&](int r, int k) { sum[r][k] = __hfma2(transmittance[r][k], steps.at(k, v[r][k]), sum[r][k]); });
  }

  // Add an exact intersection, in float.
  __device__ void add_exactly(const ExactIntersection<C>& intersection) {
    float after[C::lane_rows][2][3];
    pixels.template for_each_offset<C::Cells>(intersection.frame.optics, [&](int r, int p, int k, float s) {
      const __half2 T = transmittance[r][k];
      after[r][p][k] = p ? __high2float(T) : __low2float(T);
      intersection.add(pixels.x + p, pixels.y + 4 * r, s, k, after[r][p][k], colour[r][p][k]);
    });
    for_each([&](int r, int k) { transmittance[r][k] = __floats2half2_rn(after[r][0][k], after[r][1][k]); });
  }

  // Put the samples over the background and into the image.
  template <class Out>
  __device__ void store(const LensOptics& lens, const Staged<C::Harmonics>& staged, float4 background, Out* out) {
    const float unit = half_unit(lens);
    pixels.template store<C::Cells>(lens, out, [&](int r, int p, int k) {
      auto half = [&](__half2 h) { return p ? __high2float(h) : __low2float(h); };
      const float T = half(transmittance[r][k]);
      const float shown = fmaf(T, last_step<C>(staged, background, unit * half(v[r][k]), k), colour[r][p][k]);
      return ended(shown, T, part(background, k));
    });
  }
};

}  // namespace lfgs::cuda
