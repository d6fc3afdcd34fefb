// Compensation of a splat's opacity for two filters that spread it out. One is the blur of kBlurVariancePx in an
// anti-aliased scene (Yu et al., Mip-Splatting, 2024, the 2D filter). The other is the aperture of a camera
// (Projection::aperture_variance). So that the splat keeps its light, its opacity for camera s is multiplied by
//   sqrt(det V(s) / det (V(s) + filter)) = sqrt(D(s) / S(s)),   D(s) = D0 + D1 s + D2 s^2.
// V is the projected covariance, S(s) is as in Splat, and D(s) is S(s) without the filters.
#pragma once

#include <cmath>

#include "base/config.h"

namespace lfgs {

// The coefficients of D(s).
template <class T>
struct Compensation {
  T D0, D1, D2;
};
constexpr int kCompensationFields = 3;

// Largest D(s) / S(s) over the rig: at an end, or where the derivative is zero. The derivative has the sign of a
// parabola, for the cubes of s cancel.
template <class T>
LFGS_HD T largest_ratio(T S0, T S1, T S2, const Compensation<T>& c) {
  auto ratio = [&](T s) { return (c.D0 + s * (c.D1 + s * c.D2)) / (S0 + s * (S1 + s * S2)); };
  const T left = ratio(-1), right = ratio(1);
  T most = left > right ? left : right;
  const T bend = c.D2 * S1 - c.D1 * S2, half = c.D2 * S0 - c.D0 * S2, start = c.D1 * S0 - c.D0 * S1;
  const T square = half * half - bend * start;
  if (!(square >= 0)) return most;
  const T q = half < 0 ? std::sqrt(square) - half : -std::sqrt(square) - half;
  for (const T root : {q / bend, start / q})  // fails where a root is no number
    if (root > -1 && root < 1 && ratio(root) > most) most = ratio(root);
  return most;
}

}  // namespace lfgs
