// Intersections of halves, and the words of 32 bits in which kernels pass and store them.
#pragma once

#include <cuda_fp16.h>

namespace lfgs::cuda {

__device__ inline unsigned bits(__half2 h) { return *reinterpret_cast<const unsigned*>(&h); }
__device__ inline __half2 as_half2(unsigned b) { return *reinterpret_cast<const __half2*>(&b); }

// Two halves in the place of a float: so they can be part of a float4, which is read at once.
__device__ inline float packed(float a, float b) { return __uint_as_float(bits(__floats2half2_rn(a, b))); }
__device__ inline __half2 unpacked(float a) { return as_half2(__float_as_uint(a)); }

// max(a b + c, 0) of both halves.
__device__ inline __half2 fma_or_zero(__half2 a, __half2 b, __half2 c) {
#if __CUDA_ARCH__ >= 800
  return __hfma2_relu(a, b, c);
#else
  return __hmax2(__hfma2(a, b, c), __float2half2_rn(0.f));
#endif
}

}  // namespace lfgs::cuda
