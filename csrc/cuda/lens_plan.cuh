// How composite goes about a frame: errors and costs of its kernels, averaged over splats.
//
// A kernel evaluates r = S^(-1/2) as a polynomial in s; with relative error e of r, alpha is wrong by less than 0.74 e.
// From S = S0 (1 + a1 s + a2 s^2): r = S0^(-1/2) (1 + p1 s + p2 s^2 + p3 s^3 + p4 s^4 ...). Interpolation leaves at
// most about 3/4 (p2 + p3) with a straight line through -+ 1/2, 1/2 (p3 + p4) with a parabola through 0 and
// -+ sqrt(1/2); a third on average. One term alone says little: p2 is zero where a2 = 3/4 a1^2, p3 where a1 = 0.
#pragma once

#include "cuda/blend.cuh"
#include "cuda/lens_frame.h"
#include "math/footprint.h"
#include "math/constants.h"

namespace lfgs::cuda {

constexpr float kMeanShapeError = 6e-5f;  // of a frame, the mean over splats: keeps 80 dB at 8 bits
constexpr float kMostShapeError = 2e-3f;  // of one splat, beyond it is evaluated exactly: 0.4 of 1/255
constexpr float kStraightError = 1.6e-4f;  // of one splat, up to it is linear among quadratic ones
constexpr float kMeanHalfShapeError = 1e-3f, kMostHalfShapeError = 5e-3f;  // as above, where samples are halves
constexpr int kSampledSplats = 1 << 16;   // about; enough for averages

enum FrameSum {
  kArea, kHalfWidth, kHalfHeight, kDisparity, kDisparityHeight,
  kLinearError, kQuadraticError,  // of all splats
  kMixedError, kCurved,           // of the linear fit up to kStraightError, else the quadratic one; those of that
  kSums
};
static_assert(kSums <= sizeof(FrameState::sums) / sizeof(unsigned long long));
constexpr float kSumUnit = 1 << 4, kErrorUnit = 1 << 30;  // fixed point, so that sums have no order

struct ShapeError {
  float linear, quadratic;

  __device__ explicit ShapeError(const Splat<float>& s) {
    const float inverse = fast_reciprocal(s.S0), a1 = s.S1 * inverse, a2 = s.S2 * inverse, square = a1 * a1;
    const float p2 = fabsf(0.375f * square - 0.5f * a2), p3 = fabsf(a1 * (-0.3125f * square + 0.75f * a2));
    const float p4 = fabsf(a2 * (0.375f * a2 - 0.9375f * square) + 0.2734375f * square * square);
    linear = 0.75f * (p2 + p3);
    quadratic = 0.5f * (p3 + p4);
    // Series of what varies much say little
    if (fabsf(a1) + fabsf(a2) > 0.5f) linear = quadratic = 1;
  }
};

__host__ __device__ inline unsigned sample_stride(int64_t count) { return unsigned(count / kSampledSplats + 1); }

// By all lanes of a warp; what is not drawn adds nothing.
__device__ inline void add_to_sums(const LensFrame& frame, const Splat<float>& s) {
  unsigned long long terms[kSums] = {};
  if (s.reach_y >= 0) {
    const float range = exponent_left(s, 0.f);
    const float a = fminf(sqrtf(range * s.S0), float(frame.optics.width_px)), D = 2 * fabsf(s.du);
    const float b = fminf(s.reach_y, float(frame.optics.height_px));
    const float values[] = {3.14159265f * a * b, a, b, D, b * D};
    for (int k = 0; k < 5; ++k) terms[k] = static_cast<unsigned long long>(fminf(values[k], 1e9f) * kSumUnit);
    const ShapeError error(s);
    const bool curved = error.linear > kStraightError;
    const float means[] = {error.linear, error.quadratic, curved ? error.quadratic : error.linear, float(curved)};
    for (int k = 0; k < 4; ++k)
      terms[kLinearError + k] = static_cast<unsigned long long>(fminf(means[k], 1.f) * kErrorUnit);
  }
  const unsigned drawn = __popc(__ballot_sync(~0u, s.reach_y >= 0));
  for (int k = 0; k < kSums; ++k)
    for (int step = 16; step > 0; step /= 2) terms[k] += __shfl_xor_sync(~0u, terms[k], step);
  if (threadIdx.x % 32 == 0 && drawn) {
    atomicAdd(&frame.state->sampled, drawn);
    for (int k = 0; k < kSums; ++k) atomicAdd(&frame.state->sums[k], terms[k]);
  }
}

// Times in ms on an H200, fitted to eight frames (within 12 %): tasks * (cost * hits + set-up) / rate, in warp
// instructions of which it issues 132 x 4 x 1.98 GHz. Hits of a patch of w x h pixels that sees the fraction f of the
// rig: sum of area + (w + f D) 2 b + h 2 a + (w + f D) h over the splats, by their density. Costs of straight shapes
// among curved ones and in half precision follow from counts of instructions.
// By the thread that ends the sums.
__device__ inline void choose_kernel(const LensFrame& frame) {
  FrameState& state = *frame.state;
  float sums[kSums];  // that other blocks have just added to
  for (int k = 0; k < kSums; ++k) sums[k] = float(static_cast<volatile unsigned long long&>(state.sums[k]));
  const float sampled = float(static_cast<volatile unsigned&>(state.sampled));
  const LensOptics& lens = frame.optics;
  const float pixels = float(lens.width_px) * float(lens.height_px), rate = 1.045e9f;
  const float share = float(sample_stride(frame.splats.count));
  auto sum = [&](int k) { return sums[k] / kSumUnit * share; };
  auto hits = [&](float w, float h, float f) {
    return (sum(kArea) + 2 * w * sum(kHalfHeight) + 2 * f * sum(kDisparityHeight) + 2 * h * sum(kHalfWidth) +
            f * h * sum(kDisparity) + w * h * share * sampled) / pixels;
  };
  auto mean = [&](int k) { return sampled > 0 ? sums[k] / kErrorUnit / sampled : 0.f; };
  const bool linear = mean(kLinearError) <= (frame.in_half ? kMeanHalfShapeError : kMeanShapeError);
  const bool quadratic = mean(kQuadraticError) <= kMeanShapeError;
  const bool mixed = mean(kMixedError) <= kMeanShapeError;
  const float curved = mixed ? mean(kCurved) : 1.f;

  const float large = hits(15, 7, 1), small = hits(15, 3, 1);
  float cost[int(LensKernel::kCount)];
  auto pixel_cost = [&](float each, float of_patch) { return pixels / 128 * (each + of_patch) / rate; };
  const float each = frame.in_half ? 146 : 171, each_small = frame.in_half ? 166 : 191;
  cost[int(LensKernel::kPixel)] = linear ? pixel_cost(each * large, 115) : INFINITY;
  cost[int(LensKernel::kPixelSmall)] = linear ? pixel_cost(each_small * small, 235) : INFINITY;
  // Without a good polynomial every splat costs a division a sample
  cost[int(LensKernel::kPixelQuadratic)] = pixel_cost((quadratic ? 181 + 20 * curved : 416) * large, 115);
  cost[int(LensKernel::kPixelQuadraticSmall)] = quadratic ? pixel_cost((217 + 10 * curved) * small, 235) : INFINITY;
  const float narrowing = 1 / lens.line_number;
  const float across = (1.5f * lens.line_number + 0.5f) / 1.5f + 0.67f;
  const float tasks = 3 * pixels / 64 * ceilf(lens.line_number) / lens.line_number;
  cost[int(LensKernel::kOrdinal)] = frame.has_ordinal
      ? tasks * (60 * hits(across, 15, narrowing * 7 / 6) + 360) / rate : INFINITY;

  int best = int(LensKernel::kPixelQuadratic);
  for (int k = 0; k < int(LensKernel::kCount); ++k)
    if (cost[k] < cost[best]) best = k;
  state.kernel = frame.forced >= 0 ? frame.forced : best;
  state.exact = !quadratic && (state.kernel == int(LensKernel::kPixelQuadratic) ||
                               state.kernel == int(LensKernel::kPixelQuadraticSmall));
  state.straight = mixed ? kStraightError : 0, state.curved = curved;
}

}  // namespace lfgs::cuda
