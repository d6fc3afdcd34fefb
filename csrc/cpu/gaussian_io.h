// Common parts of both projections on the CPU: read one Gaussian, sum the gradients of its intersections, and add to
// the gradient of the Gaussian. Arithmetic is double whatever the precision of the data, which costs a few milliseconds
// and keeps needles and far-away means exact.
#pragma once

#include <algorithm>

#include "math/curved_projection.h"
#include "math/footprint.h"
#include "math/saturate.h"
#include "scene/gaussians.h"
#include "stages/stages.h"

namespace lfgs {

constexpr int64_t kGrain = 1024;  // Gaussians per work item; fixed, so that sums do not depend on the thread count

// Sum the gradients of a splat's intersections, always in the order of its bands, so that every run has the same bits.
template <class T>
void sum_intersections(const Splat<T>& splat, int64_t height_px, int64_t first, int size, const T* intersections,
                       double* sum) {
  Range rows = footprint_rows(splat, height_px);
  std::fill(sum, sum + size, 0.0);
  if (rows.last < rows.first) return;
  int64_t bands = rows.last / kBandRows - rows.first / kBandRows + 1;
  for (int64_t k = 0; k < bands; ++k)
    for (int f = 0; f < size; ++f) sum[f] += double(intersections[(first + k) * size + f]);
}

// Take the sum of the gradients of a splat's intersections to its kSplatSums numbers and back.
template <class T>
void write_sums(const IntersectionGradient<double>& sum, bool absolute, T* out) {
  const Splat<double>& g = sum.splat();
  const double numbers[kDepthSum + 1] = {g.u0, g.v0, g.log2_opacity, g.tau, g.c0, g.S0, g.depth};
  for (int k = 0; k <= kDepthSum; ++k) out[k] = saturated<T>(numbers[k]);
  for (int c = 0; c < 3; ++c) out[kColourSum + c] = saturated<T>(sum.colours()[c]);
  for (int k = 0; k < 2; ++k) out[kAbsoluteSum + k] = absolute ? saturated<T>(sum.absolute()[k]) : T(0);
}
template <class T>
void read_sums(const T* sums, bool absolute, const IntersectionGradient<double>& out) {
  out.splat() = {};
  Splat<double>& g = out.splat();
  g.u0 = sums[kPlaceSum], g.v0 = sums[kPlaceSum + 1], g.depth = sums[kDepthSum];
  g.log2_opacity = sums[kShapeSum], g.tau = sums[kShapeSum + 1], g.c0 = sums[kShapeSum + 2], g.S0 = sums[kShapeSum + 3];
  for (int c = 0; c < 3; ++c) out.colours()[c] = sums[kColourSum + c];
  for (int k = 0; absolute && k < 2; ++k) out.absolute()[k] = sums[kAbsoluteSum + k];
}

// Add the gradient of a Gaussian to the gradients of the set.
template <class T>
void add_gradient(const Shape<double>& shape, const Shape<double>& g, const Gaussians<T>& out, int64_t i) {
  const glm::dvec4 g_quaternion = quaternion_gradient(shape.quaternion, g.quaternion);
  auto add_to = [](T& sum, double value) { sum = saturated<T>(double(sum) + value); };
  for (int c = 0; c < 3; ++c) add_to(out.means[3 * i + c], g.mean[c]), add_to(out.scales[3 * i + c], g.scale[c]);
  for (int c = 0; c < 4; ++c) add_to(out.quaternions[4 * i + c], g_quaternion[c]);
  add_to(out.opacities[i], g.opacity);
}

}  // namespace lfgs
