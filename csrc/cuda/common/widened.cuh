// Cameras and Gaussians turned into double, for results that have too few digits in float.
#pragma once

#include "math/projection.h"

namespace lfgs::cuda {

__device__ inline View<double> widened(const View<float>& v) {
  View<double> view;
  view.rotation = glm::dmat3(v.rotation), view.translation = glm::dvec3(v.translation);
  view.fx = v.fx, view.fy = v.fy, view.cx = v.cx, view.cy = v.cy, view.offset = v.offset;
  view.x_low = v.x_low, view.x_high = v.x_high, view.y_low = v.y_low, view.y_high = v.y_high;
  view.sweep = v.sweep, view.inverse_zero_depth = v.inverse_zero_depth;
  return view;
}
__device__ inline Shape<double> widened(const Shape<float>& s) { return {s.mean, s.quaternion, s.scale, s.opacity}; }

}  // namespace lfgs::cuda
