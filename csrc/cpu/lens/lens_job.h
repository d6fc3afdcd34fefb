// What composite draws for the panel, or differentiates.
#pragma once

#include "stages/stages.h"

namespace lfgs {

template <class T>
struct LensJob {
  Splats<T> splats;
  Bins bins;
  const Lens* lens;
  Quality quality;
  const T* background;  // [3]
  T* out;               // one of these two
  uint8_t* out8;
  const T *image, *gradient;  // reverse only
  const int64_t* first_pair;
  T *pair_gradients, *band_background;
  bool backward;  // pair_gradients may be null in both directions: nothing may be drawn
  int threads;
};

}  // namespace lfgs
