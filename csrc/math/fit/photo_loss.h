// The loss of rendered images against photographs: the buffers of its stage, and how a sample of them is read.
#pragma once

#include <cmath>
#include <cstdint>

#include "base/config.h"

namespace lfgs {

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
