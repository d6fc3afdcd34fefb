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

}  // namespace lfgs::cuda
