// How the stages of `sorted` write and read a splat.
#pragma once

#include "cuda/sorted/sorted.h"

namespace lfgs::cuda {

static_assert(kFootprintNumbers * sizeof(float) == 2 * sizeof(float4));

__device__ inline void write_footprint(const Splat<float>& s, float* footprints, int64_t index) {
  float4* to = reinterpret_cast<float4*>(footprints) + 2 * index;
  to[0] = make_float4(s.u0, s.v0, s.c0, s.tau);
  to[1] = make_float4(s.log2_opacity, 1 / sqrtf(s.S0), s.S0, s.reach_y);
}

// The splat, without its depth.
__device__ inline Splat<float> read_footprint(const float* footprints, int64_t index) {
  const float4* from = reinterpret_cast<const float4*>(footprints) + 2 * index;
  const float4 place = __ldg(from), size = __ldg(from + 1);
  Splat<float> s{};
  s.u0 = place.x, s.v0 = place.y, s.c0 = place.z, s.tau = place.w;
  s.log2_opacity = size.x, s.S0 = size.z, s.reach_y = size.w;
  return s;
}

}  // namespace lfgs::cuda
