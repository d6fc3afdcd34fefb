// Splats of anti-aliased scenes on the device, see math/compensation.h.
#pragma once

#include "cuda/common/widened.cuh"
#include "math/projection.h"

namespace lfgs::cuda {

// A projected splat and its compensation. In double: of what is thinner than a pixel and long, the area has few digits
// left in float, where without compensation only the blur is seen of it.
__device__ inline Splat<float> compensated_splat(const View<double>& view, const Shape<float>& shape,
                                                 Compensation<float>& out) {
  const Shape<double> wide = widened(shape);
  const Projection<double> projection(view, wide);
  Splat<double> splat = projection.splat(view, wide.opacity);
  Compensation<double> exact{};
  if (splat.reach_y >= 0) projection.compensate(splat, exact);
  out = {float(exact.D0), float(exact.D1), float(exact.D2)};
  return splat_cast<float>(splat);
}

// D(s), not below zero.
__device__ inline float sharpness(const Compensation<float>& c, float s) {
  return fmaxf(fmaf(fmaf(s, c.D2, c.D1), s, c.D0), 0.f);
}

// Log2 of the share that is left of a splat's opacity at s; minus infinity of an edge.
__device__ inline float log2_share(const Compensation<float>& c, float s, float S) {
  return 0.5f * log2f(sharpness(c, s) / S);
}

}  // namespace lfgs::cuda
