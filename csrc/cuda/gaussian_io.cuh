// Reading one Gaussian on the device.
#pragma once

#include "math/projection.h"
#include "scene/gaussians.h"

namespace lfgs::cuda {

__device__ inline Shape<float> shape_of(const Gaussians<const float>& g, int64_t i) {
  const float *m = g.means + 3 * i, *q = g.quaternions + 4 * i, *s = g.scales + 3 * i;
  return {{m[0], m[1], m[2]}, {q[0], q[1], q[2], q[3]}, {s[0], s[1], s[2]}, g.opacities[i]};
}

}  // namespace lfgs::cuda
