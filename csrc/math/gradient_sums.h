// Sums over the samples that a splat touches, from which its gradient follows. g is the gradient of the exponent at a
// sample.
//   power = log2 opacity - tau dy^2 - dx^2 / S,   dx = px - m(s).
// "power" is the sum of g. "x" is the sum of the gradient of dx, -2 g dx / S. "S" is the sum of the gradient of S(s), g
// (dx / S)^2. Each also appears times powers of dy and of the sample's offset s.
#pragma once

#include "base/config.h"
#include "math/projection.h"

namespace lfgs {

// Where each sum is in an array. One camera, which is at s = 0, needs only the first kImageFootprintSums.
enum FootprintSum : int {
  kPowerSum,
  kPowerDySum,
  kPowerDy2Sum,
  kXSum,
  kXDySum,
  kSSum,
  kImageFootprintSums,
  kXsSum = kImageFootprintSums,
  kXsDySum,
  kSsSum,
  kSs2Sum,
  kDirectFootprintSums
};

// The splat's gradient, except for its depth, which is blended like a colour.
template <class R, class T>
LFGS_HD Splat<R> image_gradient(const Splat<T>& s, const R* sums) {
  Splat<R> g{};
  g.u0 = -sums[kXSum];
  g.v0 = 2 * s.tau * sums[kPowerDySum] + s.c0 * sums[kXSum];
  g.log2_opacity = sums[kPowerSum], g.tau = -sums[kPowerDy2Sum], g.c0 = -sums[kXDySum], g.S0 = sums[kSSum];
  return g;
}
template <class R, class T>
LFGS_HD Splat<R> direct_gradient(const Splat<T>& s, const R* sums) {
  Splat<R> g = image_gradient(s, sums);
  g.v0 += s.c1 * sums[kXsSum];
  g.du = -sums[kXsSum], g.c1 = -sums[kXsDySum], g.S1 = sums[kSsSum], g.S2 = sums[kSs2Sum];
  return g;
}

}  // namespace lfgs
