// What happens at one sample on the device: alpha, over, the early stop, storing; and the reverse. Twin of
// math/blend-inl.h and math/over-inl.h.
#pragma once

#include <cstdint>

#include "math/constants.h"

namespace lfgs::cuda {

// 2^x, 1 / x and x^(-1/2) to two units in the last place, without care for numbers too small to be normal.
__device__ inline float fast_exp2(float x) {
  float y;
  asm("ex2.approx.ftz.f32 %0, %1;" : "=f"(y) : "f"(x));
  return y;
}
__device__ inline float fast_reciprocal(float x) {
  float y;
  asm("rcp.approx.ftz.f32 %0, %1;" : "=f"(y) : "f"(x));
  return y;
}

__device__ inline float fast_rsqrt(float x) {
  float y;
  asm("rsqrt.approx.ftz.f32 %0, %1;" : "=f"(y) : "f"(x));
  return y;
}

// alpha = min(0.99, 2^power), zero where it is below 1/255 (or power is not a number).
__device__ inline float alpha_of(float power) {
  const float alpha = fast_exp2(power);
  return power >= float(kLog2MinAlpha) ? fminf(alpha, float(kMaxAlpha)) : 0.f;
}

// Light that a sample still takes; `weight` receives the share of this splat. A sample whose transmittance would fall
// below the limit keeps what is left for the background (`rest`) and takes no more: its transmittance becomes zero.
__device__ inline void over(float alpha, float& transmittance, float& rest, float& weight) {
  weight = alpha * transmittance;
  const float after = transmittance - weight;
  if (after < float(kMinTransmittance)) {
    rest = transmittance > 0 ? transmittance : rest;
    weight = transmittance = 0;
  } else {
    transmittance = after;
  }
}

// The same splat on the way back: the sample's transmittance loses what it lost to over(), and where the sample ended
// before the splat, alpha becomes zero. Returns the weight.
__device__ inline float over_again(float& alpha, float& transmittance) {
  const float before = transmittance, after = before - alpha * before;
  const bool open = after >= float(kMinTransmittance);
  alpha = open ? alpha : 0.f, transmittance = open ? after : 0.f;
  return alpha * before;
}

// dL/dalpha of a splat, see math/over-inl.h: v is what a unit of its weight adds to the loss, `later` the sum of all
// that is behind it. kEstimate: divides by an estimate; the lens sensor divides, as on the CPU.
template <bool kEstimate>
__device__ inline float over_adjoint(float alpha, float before, float v, float later) {
  return before * v - (kEstimate ? later * fast_reciprocal(1 - alpha) : later / (1 - alpha));
}

__device__ inline float remaining(float transmittance, float rest) { return transmittance > 0 ? transmittance : rest; }

// What a sample shows, given what it would show if splats went on for ever, and the transmittance then. It ends before
// the splat that would leave less than 1e-4 (Kerbl et al.), and its background has what is left before: usually little
// more than that. Fast kernels do not ask at every splat; this puts right what they draw too much, but for a tenth.
__device__ inline float ended(float colour, float transmittance, float background) {
  constexpr float kUsualRest = 1.15f * float(kMinTransmittance);
  const bool full = transmittance > 0 && transmittance < float(kMinTransmittance);
  return full ? fmaf(kUsualRest - transmittance, background - colour, colour) : colour;
}

// A colour as it stands in an image of floats or of bytes; ties go to even.
__device__ inline float stored(float c, float*) { return c; }
__device__ inline uint8_t stored(float c, uint8_t*) {
  return uint8_t(__float2uint_rn(fminf(fmaxf(c, 0.f), 1.f) * 255.f));
}

// Sum over the lanes of a warp, in a fixed order; every lane receives it.
__device__ inline float warp_sum(float v) {
  for (int step = 16; step > 0; step /= 2) v += __shfl_xor_sync(~0u, v, step);
  return v;
}
// The largest.
__device__ inline float warp_max(float v) {
  for (int step = 16; step > 0; step /= 2) v = fmaxf(v, __shfl_xor_sync(~0u, v, step));
  return v;
}

// The sum of the numbers of a warp's lanes, up to one's own.
template <class T>
__device__ T sum_to_lane(T number) {
  for (int step = 1; step < 32; step *= 2) {
    const T other = __shfl_up_sync(~0u, number, step);
    if (int(threadIdx.x % 32) >= step) number += other;
  }
  return number;
}

}  // namespace lfgs::cuda
