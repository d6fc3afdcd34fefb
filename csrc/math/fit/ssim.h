// Structural similarity at one sample (Wang et al., "Image quality assessment: from error visibility to structural
// similarity", 2004, eq. 13), and what it changes by when the five blurred moments do. The window is a Gaussian of 11
// taps with sigma 1.5; beyond the image all is zero.
#pragma once

#include <cmath>

#include "base/config.h"

namespace lfgs {

constexpr int kWindowReach = 5, kWindow = 2 * kWindowReach + 1;  // pixels

// The weight of a tap 0..10: exp(-((tap - 5) / 1.5)^2 / 2), over the sum of all.
LFGS_HD constexpr double window_tap(int tap) {
  const int distance = tap < kWindowReach ? kWindowReach - tap : tap - kWindowReach;
  return distance == 0   ? 0.2660117248617943
         : distance == 1 ? 0.21300553771125366
         : distance == 2 ? 0.1093606895097
         : distance == 3 ? 0.03600077212843082
         : distance == 4 ? 0.007598758135239184
                         : 0.001028380084479109;
}

// (0.01 L)^2 and (0.03 L)^2 of the paper for a range of L = 1.
constexpr double kSsimMeans = 1e-4, kSsimVariances = 9e-4;

// Blurred moments of the image x and the photo y.
template <class R>
struct SsimMoments {
  R x, y, xx, yy, xy;
};

// The similarity, and its derivatives by the moments that hold x.
template <class R>
struct Ssim {
  R value, by_x, by_xx, by_xy;
};

// Variances are not below zero, which rounding could make of them. (v + |v|) / 2 is their greater part: a comparison
// would keep compilers from using vectors.
template <class R>
LFGS_HD Ssim<R> compute_ssim(const SsimMoments<R>& m) {
  const R c1 = R(kSsimMeans), c2 = R(kSsimVariances), product = m.x * m.y, squares = m.x * m.x + m.y * m.y;
  const R variances = m.xx + m.yy - squares;
  const R inverse_means = 1 / (squares + c1), inverse_variances = 1 / (R(0.5) * (variances + std::abs(variances)) + c2);
  const R luminance = (2 * product + c1) * inverse_means;
  const R structure = (2 * (m.xy - product) + c2) * inverse_variances;
  const R value = luminance * structure;
  return {value,
          2 * (m.y * (structure * inverse_means - luminance * inverse_variances) +
               m.x * value * (inverse_variances - inverse_means)),
          -value * inverse_variances, 2 * luminance * inverse_variances};
}

// d(loss)/dx of one sample, without the factors of the mean: the derivatives by the moments, blurred, times those of
// the moments by x.
template <class R>
LFGS_HD R ssim_gradient(R by_x, R by_xx, R by_xy, R x, R y) {
  return by_x + 2 * x * by_xx + y * by_xy;
}

}  // namespace lfgs
