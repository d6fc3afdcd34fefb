// The panel: which view, hence which camera offset, every sub-pixel shows.
#pragma once

#include <cstdint>

#include "base/config.h"

namespace lfgs {

struct Lens {
  int64_t width_px = 0, height_px = 0;
  int64_t views = 1;
  uint64_t phase0 = 0, phase_x = 0, phase_y = 0;  // 2^64 = one lens: at the origin, per sub-pixel, per row
  double line_number = 1;                         // P_e: lens width in sub-pixels
  double slant_tan = 0;
  double phase = 0;                               // D_0, sub-pixels
  bool bgr = false;                               // blue is the left-most sub-pixel
  bool continuous = false;                        // cameras at x itself instead of floor(x) + 1/2
  double offset_start = 0, offset_step = 0;       // s = offset_start + offset_step * x, scene units

  LFGS_HD uint64_t phase_at(int64_t row, int64_t subpixel) const {
    return phase0 + phase_x * uint64_t(subpixel) + phase_y * uint64_t(row);
  }
  // Largest |s| over x in [0, views].
  LFGS_HD double reach() const {
    double a = offset_start, b = offset_start + offset_step * double(views);
    a = a < 0 ? -a : a;
    b = b < 0 ? -b : b;
    return a > b ? a : b;
  }
  // Normalized offset, in [-1, 1]: s = s_start() + s_step() * x; zero on a rig without width.
  LFGS_HD double s_start() const { return reach() > 0 ? offset_start / reach() : 0; }
  LFGS_HD double s_step() const { return reach() > 0 ? offset_step / reach() : 0; }
};

// Integer view of a phase: the high part of phase * views, exact.
LFGS_HD int64_t integer_view(uint64_t phase, uint64_t views) {
  uint64_t high = phase >> 32, low = phase & 0xffffffffu;
  return int64_t((high * views + (low * views >> 32)) >> 32);
}

// The camera coordinate x in [0, views] of a phase: n + 1/2, or x itself.
LFGS_HD double camera_coordinate(const Lens& lens, uint64_t phase) {
  if (!lens.continuous) return double(integer_view(phase, uint64_t(lens.views))) + 0.5;
  return double(phase) * (1.0 / 18446744073709551616.0) * double(lens.views);
}

}  // namespace lfgs
