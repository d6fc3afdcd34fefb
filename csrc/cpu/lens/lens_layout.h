// How the panel is cut into cells and tiles; the same for a whole frame.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>

#include "math/footprint.h"
#include "stages/stages.h"
#include "scene/lens.h"

namespace lfgs {

struct LensLayout {
  bool by_lens = true;  // cells are lenses; false: cells are single sub-pixels
  double pitch = 1;     // cell width, sub-pixels
  double shear = 0;     // sub-pixels that the cells lean to the left per row
  double origin = 0;    // cell coordinate (sub-pixels) of the image's top left corner
  int ordinals = 1;     // most sub-pixels in a cell
  int cells_per_tile = 16;
  double s_start = 0, s_step = 0;                            // normalized offset s in [-1, 1] = s_start + s_step * x
  double s_of_ordinal_0 = 0, s_per_ordinal = 0, half_s = 0;  // of the samples at ordinal t: centre, and half spread
  double x_per_ordinal = 1;  // pixels from one ordinal to the next; 1 where there is one ordinal only
  float half_patch_px = 0;   // half spread in x of a patch's samples at one ordinal, rows apart
  // Of sub-pixels that do not stand in stripes: how far aside, at most; and so many before that of the first stripe of
  // a lens, and after that of the last, may be of this lens
  double beyond = 0;
  int lead = 0;

  LensLayout(const Lens& lens, int cells_per_patch) {
    // A lens must hold a few sub-pixels for its phase to be told from its neighbours', and few enough for a 64-bit mask
    const double least = lens.has_cells ? 6 : 3, most = lens.has_cells ? 61 : 63;
    by_lens = lens.line_number >= least && lens.line_number <= most && lens.stands_in_order();
    beyond = lens.most_beyond();
    s_start = lens.s_start(), s_step = lens.s_step();
    if (by_lens) {
      pitch = lens.line_number, shear = 3 * lens.slant_tan, origin = lens.phase;
      lead = lens.has_cells ? 1 : 0;
      ordinals = int(std::ceil(pitch)) + 2 * lead, x_per_ordinal = 1.0 / 3;
      const double views_per_ordinal = double(lens.views) / pitch;
      s_per_ordinal = s_step * views_per_ordinal;
      s_of_ordinal_0 = s_start + (0.5 - lead) * s_per_ordinal;
      half_s = std::abs(s_step) * ((0.5 + beyond) * views_per_ordinal + (lens.continuous ? 0 : 0.5)) + 1e-6;
    } else {
      cells_per_tile = 96;
    }
    // A sub-pixel stands up to 1/3 px from its pixel's centre; lens edges are rounded up to whole sub-pixels
    half_patch_px = float((cells_per_patch - 1) * pitch / 6 + 0.5 + 0.02);
  }

  int64_t samples() const { return int64_t(kBandRows) * cells_per_tile * ordinals; }

  // x (pixels) of the samples at ordinal 0 of a cell, in the mean.
  double cell_x(double cell, double row) const {
    return (cell * pitch - shear * row - origin - lead) / 3 + (by_lens ? 1.0 / 3 : 1.0 / 6);
  }

  // First sub-pixel of a cell in a row.
  int64_t cell_start(const Lens& lens, int64_t row, int64_t cell) const {
    int64_t m = first_stripe(lens, row, cell);
    if (lead == 0) return m;
    constexpr int64_t kAbove = int64_t(kRowPeriod) << 40;  // so that remainders have no sign
    auto inside = [&](int64_t at) {
      const uint64_t aside = lens.cells.phases[row % kCellPeriod][(at + kAbove) % kRowPeriod];
      return int64_t(lens.phase_at(row, at) + aside) >= 0;
    };
    while (inside(m - 1)) --m;
    while (!inside(m)) ++m;
    return m;
  }

  // Where it would begin with stripes: an estimate, made exact by the fixed-point phase.
  int64_t first_stripe(const Lens& lens, int64_t row, int64_t cell) const {
    if (!by_lens) return cell;
    const int64_t m = int64_t(std::ceil(double(cell) * pitch - shear * double(row) - origin));
    const uint64_t phase = lens.phase_at(row, m);
    return phase < lens.phase_x ? m : phase >> 63 ? m + 1 : m - 1;
  }

  // Cells that samples of columns [low, high] (pixels, at row 0 after shearing by shear / 3) belong to.
  Range cells_of(double low, double high) const {
    const double aside = by_lens ? beyond : 0;
    return {int64_t(std::floor((3 * (low - 0.5) - aside + origin) / pitch - 1e-6)),
            int64_t(std::floor((3 * (high - 0.5) + 2 + aside + origin) / pitch + 1e-6))};
  }

  // Cells that a band shows.
  Range cells_of_band(const Lens& lens, int64_t row0) const {
    const double last_row = double(std::min(row0 + kBandRows, lens.height_px) - 1);
    const double a = shear * double(row0), b = shear * last_row;
    return {int64_t(std::floor((std::min(a, b) + origin) / pitch)) - 1,
            int64_t(std::floor((std::max(a, b) + origin + double(3 * lens.width_px - 1)) / pitch)) + 1};
  }
};

}  // namespace lfgs
