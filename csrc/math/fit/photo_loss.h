// The loss of rendered images against photographs: SSIM at one sample, the buffers of the stage, and how it reads them.
#pragma once

#include <cmath>
#include <cstdint>

#include "base/config.h"

namespace lfgs {

// SSIM (Wang et al., "Image quality assessment: from error visibility to structural similarity", 2004, eq. 13) is a
// function of five blurred moments. The window is a Gaussian of 11 taps with sigma 1.5; beyond the image all is zero.
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

// d(loss)/dx of one sample, without the factors of the mean: the blurred derivatives by the moments, times the
// derivatives of the moments by x.
template <class R>
LFGS_HD R ssim_gradient(R by_x, R by_xx, R by_xy, R x, R y) {
  return by_x + 2 * x * by_xx + y * by_xy;
}

// V images of H x W pixels, row-major. The loss is summed over the images. w are the weights, x is the image, y the
// photo, and x' = w x + (1 - w) y.
//   sum over samples of ((1 - ssim_lambda) |x' - y| + ssim_lambda w (1 - SSIM(x', y))) / (3 H W).
// Samples without weight thus look as in the photo, also to the windows of their neighbours, and add nothing.
template <class T>
struct PhotoLoss {
  int64_t images = 0, height_px = 0, width_px = 0;
  const T* image = nullptr;              // [V, H, W, 3] x, any finite numbers
  const T* photo = nullptr;              // [V, H, W, 3] y, or null
  const uint8_t* photo_bytes = nullptr;  // the same in steps of 1/255; one of the two is null
  const float* weights = nullptr;        // [V, H, W] 0..1, or null for 1 everywhere
  double ssim_lambda = 0.2;              // 0..1
  T* derivatives = nullptr;              // [3, V, H, W, 3] scratch: of w SSIM by the blurred x, x x, x y
  double* partials = nullptr;            // scratch: as many as the device's photo_loss_partials says
  T* loss = nullptr;                     // one number, written
  T* gradient = nullptr;                 // [V, H, W, 3] of the loss, written

  LFGS_HD int64_t row() const { return 3 * width_px; }                    // samples of a row
  LFGS_HD int64_t samples() const { return images * height_px * row(); }  // of all images
  LFGS_HD double sample_weight() const { return 1 / double(height_px * row()); }
  LFGS_HD T weight_at(int64_t sample) const { return weights ? T(weights[sample / 3]) : T(1); }
  LFGS_HD T photo_at(int64_t sample) const {
    return photo_bytes ? T(photo_bytes[sample]) * T(1.0 / 255) : photo[sample];
  }
  // x' of a sample, from its y and w. An image that has no weight may be no number.
  LFGS_HD T image_at(int64_t sample, T y, T w) const {
    const T mixed = w * image[sample] + (1 - w) * y;
    return w > 0 ? mixed : y;
  }
};

// The loss of a sample, before sample_weight().
template <class R>
LFGS_HD R sample_loss(R x, R y, R w, R ssim, R ssim_lambda) {
  return (1 - ssim_lambda) * std::abs(x - y) + ssim_lambda * w * (1 - ssim);
}

// d(loss)/d(image) of a sample, before sample_weight(). ssim_by_x: derivative of the sum of w SSIM by x'. At
// x = y the loss of L1 has a corner, where it counts as flat.
template <class R>
LFGS_HD R sample_gradient(R x, R y, R w, R ssim_by_x, R ssim_lambda) {
  const R sign = R(x > y) - R(x < y);
  return w * ((1 - ssim_lambda) * sign - ssim_lambda * ssim_by_x);
}

}  // namespace lfgs
