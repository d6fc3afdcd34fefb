// Arithmetic of one sample on the device: alpha, blending, the early end, storing, and the backward pass of blending.
// Also sums over the lanes of a warp. Twin of math/blend-inl.h and math/over-inl.h.
#pragma once

#include <cstdint>

#include "math/constants.h"

namespace lfgs::cuda {

// 2^x, 1 / x, x^(-1/2) and x^(1/2) to two units in the last place. Numbers too small to be normal count as zero.
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

__device__ inline float fast_sqrt(float x) {
  float y;
  asm("sqrt.approx.ftz.f32 %0, %1;" : "=f"(y) : "f"(x));
  return y;
}

// alpha = min(0.99, 2^power), or zero where that is below 1/255 (or power is not a number).
__device__ inline float to_alpha(float power) {
  const float alpha = fast_exp2(power);
  return power >= float(kLog2MinAlpha) ? fminf(alpha, float(kMaxAlpha)) : 0.f;
}

// Blend a splat of this alpha into a sample: update its transmittance, and `weight` receives the splat's part of the
// light. A sample whose transmittance would fall below the limit ends. It keeps the rest for the background (`rest`),
// and its transmittance becomes zero.
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

// The same in the backward pass, which walks front to back as well: the sample's transmittance loses again what it lost
// to over(). Where the sample ended before this splat, alpha becomes zero. Return the weight.
__device__ inline float over_again(float& alpha, float& transmittance) {
  const float before = transmittance, after = before - alpha * before;
  const bool open = after >= float(kMinTransmittance);
  alpha = open ? alpha : 0.f, transmittance = open ? after : 0.f;
  return alpha * before;
}

// dL/dalpha of a splat, see math/over-inl.h. `before`: the transmittance before it; v: the derivative of the loss by
// its weight; `later`: the part of the loss of everything behind it. kEstimate: whether an approximate division will
// do; panels divide exactly, as on the CPU.
template <bool kEstimate>
__device__ inline float over_backward(float alpha, float before, float v, float later) {
  return before * v - (kEstimate ? later * fast_reciprocal(1 - alpha) : later / (1 - alpha));
}

// The light of a sample that is left for the background.
__device__ inline float remaining(float transmittance, float rest) { return transmittance > 0 ? transmittance : rest; }

// The colour of a sample that ends in time, given the colour and the transmittance it has when it does not. A sample
// ends before the splat that would leave less than 1e-4 of its light (Kerbl et al.). The background gets the light
// before that splat, usually little more than 1e-4. Fast kernels do not test at every splat whether the sample ends.
// This corrects the surplus that they draw, up to about a tenth of it.
__device__ inline float ended(float colour, float transmittance, float background) {
  constexpr float kUsualRest = 1.15f * float(kMinTransmittance);
  const bool full = transmittance > 0 && transmittance < float(kMinTransmittance);
  return full ? fmaf(kUsualRest - transmittance, background - colour, colour) : colour;
}

// A colour as it stands in an image of floats or of bytes; ties go to even. Conversions are slow, so instead a number
// is added that leaves the byte in the last bits of the sum. Both operations round, as on the CPU: one that rounds once
// makes other bytes of ties.
__device__ inline float stored(float c, float*) { return c; }
__device__ inline uint8_t stored(float c, uint8_t*) {
  constexpr float kWholes = 1 << 23;  // from here on floats are whole numbers
  return uint8_t(__float_as_uint(__fadd_rn(__fmul_rn(__saturatef(c), 255.f), kWholes)));
}

// The sum over the lanes of a warp, in a fixed order; every lane receives it.
template <class T>
__device__ T warp_sum(T v) {
  for (int step = 16; step > 0; step /= 2) v += __shfl_xor_sync(~0u, v, step);
  return v;
}
// The largest of the lanes' numbers; every lane receives it.
__device__ inline float warp_max(float v) {
  for (int step = 16; step > 0; step /= 2) v = fmaxf(v, __shfl_xor_sync(~0u, v, step));
  return v;
}

// Write the sums of a block over its threads' numbers to `out`, always in the same order: over each warp, then over the
// warps. number(k) is a thread's number k of kNumbers.
template <int kWarps, int kNumbers, class T, class Number>
__device__ void store_block_sums(const Number& number, T (&partial)[kWarps][kNumbers], T* out) {
  for (int k = 0; k < kNumbers; ++k) {
    const T sum = warp_sum(number(k));
    if (threadIdx.x % 32 == 0) partial[threadIdx.x / 32][k] = sum;
  }
  __syncthreads();
  if (threadIdx.x < kNumbers) {
    T sum = 0;
    for (int w = 0; w < kWarps; ++w) sum += partial[w][threadIdx.x];
    out[threadIdx.x] = sum;
  }
  __syncthreads();
}

// The sum of the numbers of a warp's lanes, up to and with this lane's.
template <class T>
__device__ T sum_to_lane(T number) {
  for (int step = 1; step < 32; step *= 2) {
    const T other = __shfl_up_sync(~0u, number, step);
    if (int(threadIdx.x % 32) >= step) number += other;
  }
  return number;
}

}  // namespace lfgs::cuda
