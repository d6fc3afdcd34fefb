// How kernels read a Gaussian and write its gradient, and how they read and write a splat.
#pragma once

#include <cstdint>

#include "math/harmonics.h"
#include "math/projection.h"
#include "math/saturate.h"
#include "scene/gaussians.h"

namespace lfgs::cuda {

// Read all harmonics of one Gaussian; those beyond its degree are zero. It reads 16 bytes at a time where they are
// aligned. Lanes read places far apart, so each load costs a cache line a lane.
__device__ inline void read_harmonics(const Gaussians<const float>& g, int64_t i, float (&sh)[3 * kMaxShCount]) {
  const int numbers = 3 * g.sh_count();
  const float* from = g.sh + numbers * i;
  if (numbers % 4 == 0 && reinterpret_cast<uintptr_t>(g.sh) % sizeof(float4) == 0) {
#pragma unroll
    for (int k = 0; k < 3 * kMaxShCount; k += 4) {
      const float4 v = k < numbers ? __ldg(reinterpret_cast<const float4*>(from + k)) : make_float4(0, 0, 0, 0);
      sh[k] = v.x, sh[k + 1] = v.y, sh[k + 2] = v.z, sh[k + 3] = v.w;
    }
  } else {
#pragma unroll
    for (int k = 0; k < 3 * kMaxShCount; ++k) sh[k] = k < numbers ? from[k] : 0;
  }
}

// Write the gradient of one Gaussian, without its harmonics; g.quaternion is the gradient of the unit quaternion.
template <class R>
__device__ void store_gradient(const Shape<float>& shape, const Shape<R>& g, const Gaussians<float>& out, int64_t i) {
  const glm::dvec4 g_quaternion = quaternion_gradient(shape.quaternion, g.quaternion);
  for (int c = 0; c < 3; ++c)
    out.means[3 * i + c] = saturated<float>(g.mean[c]), out.scales[3 * i + c] = saturated<float>(g.scale[c]);
  for (int c = 0; c < 4; ++c) out.quaternions[4 * i + c] = saturated<float>(g_quaternion[c]);
  out.opacities[i] = saturated<float>(g.opacity);
}

// A splat is three vectors of 16 bytes in memory.
static_assert(sizeof(Splat<float>) == 3 * sizeof(float4));

__device__ inline Splat<float> read_splat(const Splat<float>* from) {
  union {
    float4 vectors[3];
    Splat<float> splat;
  } u;
  for (int k = 0; k < 3; ++k) u.vectors[k] = __ldg(reinterpret_cast<const float4*>(from) + k);
  return u.splat;
}

__device__ inline void write_splat(const Splat<float>& splat, Splat<float>* to) {
  union {
    float4 vectors[3];
    Splat<float> splat;
  } u;
  u.splat = splat;
  for (int k = 0; k < 3; ++k) reinterpret_cast<float4*>(to)[k] = u.vectors[k];
}

}  // namespace lfgs::cuda
