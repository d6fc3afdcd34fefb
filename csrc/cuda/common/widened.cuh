// Gaussians turned into double, for results that have too few digits in float.
#pragma once

#include "math/projection.h"

namespace lfgs::cuda {

__device__ inline Shape<double> widened(const Shape<float>& s) { return {s.mean, s.quaternion, s.scale, s.opacity}; }

}  // namespace lfgs::cuda
