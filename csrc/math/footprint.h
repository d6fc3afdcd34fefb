// Where the alpha of a splat may be above the opacity cut: its rows and columns, from which bands and tiles follow.
// Bounds err on the wide side. Also what changes a footprint: raising the cut, and culling.
#pragma once

#include <cmath>

#include "base/config.h"
#include "math/constants.h"
#include "math/projection.h"

namespace lfgs {

// Values of reach_y for splats that are not drawn: because they are not seen, or because they have so little light.
constexpr int kNotSeen = -1, kPruned = -2;

struct Range {
  int64_t first, last;  // empty when last < first
};

// Pixels (or rows) of [0, size) whose centres lie in [low, high], with a margin for rounding.
template <class T>
LFGS_HD Range pixels_within(T low, T high, int64_t size) {
  const T margin = T(0.01);
  low = std::ceil(low - T(0.5) - margin), high = std::floor(high - T(0.5) + margin);
  if (!(low <= high) || high < 0 || low > T(size - 1)) return {0, -1};
  return {low <= 0 ? 0 : int64_t(low), high >= T(size - 1) ? size - 1 : int64_t(high)};
}

// Rows of the image that the footprint touches.
template <class T>
LFGS_HD Range footprint_rows(const Splat<T>& s, int64_t height_px) {
  if (!(s.reach_y >= 0)) return {0, -1};
  return pixels_within(s.v0 - s.reach_y, s.v0 + s.reach_y, height_px);
}

// How far the exponent at the middle of a row at distance dy from the centre lies above the opacity cut.
template <class T>
LFGS_HD T exponent_left(const Splat<T>& s, T dy) {
  dy = std::fabs(dy);
  return s.tau * (s.reach_y - dy) * (s.reach_y + dy);
}

// Squared half width, in px^2, of the footprint over rows no nearer to v0 than dy, for the widest camera of the rig.
template <class T>
LFGS_HD T square_reach_x(const Splat<T>& s, T dy) {
  T left = s.S0 - s.S1 + s.S2, right = s.S0 + s.S1 + s.S2;
  T exponent = exponent_left(s, dy);
  return exponent > 0 ? exponent * (left > right ? left : right) : T(0);
}

// Find the interval of x + shear * (y - 1/2) that the footprint covers, for all cameras, in the rows whose centres are
// in [y_low, y_high]. Return false if it touches none of these rows.
template <class T>
LFGS_HD bool footprint_columns(const Splat<T>& s, T y_low, T y_high, T shear, T& low, T& high) {
  T d1 = y_low - s.v0, d2 = y_high - s.v0;
  d1 = d1 > -s.reach_y ? d1 : -s.reach_y, d2 = d2 < s.reach_y ? d2 : s.reach_y;
  const T margin = T(0.01);
  if (!(d1 <= d2 + 2 * margin)) return false;

  // Half width in the nearest row; then the middle of the footprint, and how far it moves over the rows and the rig
  T nearest = d1 > 0 ? d1 : d2 < 0 ? -d2 : T(0);
  T half = std::sqrt(square_reach_x(s, nearest)) + margin;
  T middle = (d1 + d2) / 2, spread = std::fabs(d2 - d1) / 2;
  T centre = s.u0 + s.c0 * middle + shear * (s.v0 + middle - T(0.5));
  half += std::fabs(s.c0 + shear) * spread + std::fabs(s.du + s.c1 * middle) + std::fabs(s.c1) * spread;
  low = centre - half, high = centre + half;
  return true;
}

// How many pixels patches that touch an ellipse reach beyond it, on average.
constexpr int kPatchMargin = 6;

// A raised cut gives up the ring where a splat's alpha lies between 1/255 and the cut. Kernels that draw whole patches
// still draw the pixels within `margin_px` of the ellipse inside the ring. This is the fraction of the ring that is
// left out.
template <class T>
LFGS_HD T fraction_left_out(const Splat<T>& s, T log2_cut, T margin_px) {
  const T deviation = std::sqrt(std::sqrt(s.S0 / s.tau)), inside = s.log2_opacity - log2_cut;
  const T ring = deviation * (std::sqrt(s.log2_opacity - T(kLog2MinAlpha)) - (inside > 0 ? std::sqrt(inside) : T(0)));
  return ring > 0 ? ring / (ring + margin_px) : T(1);
}

// Raise the opacity cut of a splat from 1/255, and its opacity by as much. The integral of alpha over an image, which
// is proportional to opacity - cut, stays the same, except where the opacity ends at 0.99. by_patches: alphas from
// 1/255 on are drawn in whole patches that the cut touches, so that less is left out.
template <class T>
LFGS_HD void raise_cut(Splat<T>& s, T log2_cut, bool by_patches) {
  if (!(s.reach_y >= 0)) return;
  const T fraction = by_patches ? fraction_left_out(s, log2_cut, T(kPatchMargin)) : T(1);
  const T raised = std::log2(std::exp2(s.log2_opacity) + fraction * (std::exp2(log2_cut) - T(kMinAlpha)));
  const T most = T(kLog2MaxAlpha) > s.log2_opacity ? T(kLog2MaxAlpha) : s.log2_opacity;
  s.log2_opacity = raised < most ? raised : most;
  s.reach_y = s.log2_opacity >= log2_cut ? std::sqrt((s.log2_opacity - log2_cut) / s.tau) : T(kNotSeen);
}

// Return the sum of a splat's alphas over the pixels for the camera that sees it widest, without edges, cuts or limits.
// It is the integral of 2^(log2_opacity - tau dy^2 - dx^2 / S).
template <class T>
LFGS_HD T alpha_integral(const Splat<T>& s) {
  const T left = s.S0 - s.S1 + s.S2, right = s.S0 + s.S1 + s.S2;
  return std::exp2(s.log2_opacity) * T(kPi / kLn2) * std::sqrt((left > right ? left : right) / s.tau);
}

// Mark splats as not seen that touch no pixel of the image from any camera of the rig, or whose numbers overflowed.
template <class T>
LFGS_HD void cull_outside(Splat<T>& s, int64_t width_px, int64_t height_px) {
  if (!(s.reach_y >= 0)) return;
  T sum = s.u0 + s.v0 + s.reach_y + s.S0, low, high;
  bool finite = sum - sum == 0;
  if (!finite || footprint_rows(s, height_px).last < 0 ||
      !footprint_columns(s, T(0.5), T(height_px) - T(0.5), T(0), low, high) || high < 0 || low > T(width_px))
    s.reach_y = kNotSeen;
}

}  // namespace lfgs
