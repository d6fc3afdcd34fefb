// Weaving: pictures of M views, of any size and number, to the image of a panel. The parameters are described in
// lightfield_gs/encoding/weave.py; every buffer belongs to the caller.
#pragma once

#include <cstdint>

#include "scene/subpixels.h"

namespace lfgs {

// Where the sub-pixels of a panel stand among the M views, 0 being the left-most camera's.
struct WeaveFan {
  ViewMap map;                     // the panel's view of each sub-pixel
  const double* places = nullptr;  // [map.views] where each of the panel's views stands, 0 .. M - 1
  bool continuous = false;         // by the lens's exact x, places unused
  bool inverted = false;           // x counts from the left-most camera (continuous only)
  int64_t views = 1;               // M
  double box = 0;                  // how many views wide each sub-pixel averages; 0: it takes the nearest one
};

// The part of a view that the panel shows, in fractions of the view; see Window in
// lightfield_gs/encoding/weave_geometry.py.
struct WeaveWindow {
  double left = 0, top = 0, width = 1, height = 1;
  double low_x = 0, low_y = 0, high_x = 1, high_y = 1;
  double shift = 0;
};

// Pictures first .. first + held - 1 of the M, [held, H, W, 3]. Sub-pixels whose first view is one of the first `own`
// of them are drawn, the others left as they are.
template <class T>
struct WeaveViews {
  const T* pixels = nullptr;
  int64_t first = 0, own = 0, held = 0, height_px = 0, width_px = 0;
};

// Draw the sub-pixels that the views reach into the panel's image, out [H, W, 3]. T: uint8_t, uint16_t or float.
template <class T>
void weave(const WeaveViews<T>& views, const WeaveWindow& window, const WeaveFan& fan, T* out, int threads);

}  // namespace lfgs
