// What composite reads and writes for the panel, in both directions. composite_direct.cpp fills one DirectJob for an
// image, and all workers read it.
#pragma once

#include "stages/stages.h"

namespace lfgs {

template <class T>
struct DirectJob {
  Splats<T> splats;
  Bins bins;
  const Lens* lens;
  Quality quality;
  const T* background;  // [3]
  T* out;               // the image, [H, W, 3], is written here, or as bytes to out8; the other is null
  uint8_t* out8;
  const T *image, *gradient;  // backward pass only: the image that was drawn, and the gradient of the loss by it
  const int64_t* first_intersection;
  T *intersection_gradients, *band_background;
  bool backward;  // the direction; intersection_gradients cannot tell, for it is also null where no splat is drawn
  int threads;
};

}  // namespace lfgs
