// How the panel is cut into cells (lenses, or single sub-pixels where lenses are too narrow or too wide) and into tiles
// of neighbouring cells. It follows from the lens alone and is worked out once for an image; tiles, lists and lattices
// are laid out by it. Runs of neighbouring cells, of which lattices and the background are drawn, are here too.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <vector>

#include "math/footprint.h"
#include "stages/stages.h"
#include "scene/lens.h"
#include "math/lattice_plan.h"

namespace lfgs {

struct LensLayout {
  bool by_lens = true;   // cells are lenses; false: cells are single sub-pixels
  double pitch = 1;      // cell width, sub-pixels
  double shear = 0;      // sub-pixels that the cells lean to the left per row
  double origin = 0;     // cell coordinate (sub-pixels) of the image's top left corner
  int lens_columns = 1;  // most sub-pixels in a cell
  int cells_per_tile = 16;
  double s_start = 0, s_step = 0;  // normalized offset s = s_start + s_step * x, in [-1, 1]
  // Samples at lens column t have offsets within half_s of s_of_column_0 + t * s_per_column
  double s_of_column_0 = 0, s_per_column = 0, half_s = 0;
  double x_per_column = 1;  // pixels from one lens column to the next; 1 where there is one lens column only
  float half_patch_px = 0;  // half spread in x of a patch's samples at one lens column, within a row
  // For panels whose sub-pixels do not stand in stripes. `beyond`: the largest distance of a sub-pixel from its stripe,
  // in sub-pixels. `lead`: how many sub-pixels before the first stripe of a lens may belong to it, and how many after
  // its last.
  double beyond = 0;
  int lead = 0;

  LensLayout(const Lens& lens, int cells_per_patch) {
    // A lens must hold a few sub-pixels, so that phases tell it from its neighbours (first_stripe). It may have 64 lens
    // columns at most: DirectTile has as many spare entries behind its list.
    const double least = lens.has_cells ? 6 : 3, most = lens.has_cells ? 61 : 63;
    by_lens = lens.line_number >= least && lens.line_number <= most && lens.stands_in_order();
    beyond = lens.most_beyond();
    s_start = lens.s_start(), s_step = lens.s_step();
    if (by_lens) {
      pitch = lens.line_number, shear = 3 * lens.slant_tan, origin = lens.phase;
      lead = lens.has_cells ? 1 : 0;
      lens_columns = int(std::ceil(pitch)) + 2 * lead, x_per_column = 1.0 / 3;
      const double views_per_column = double(lens.views) / pitch;
      s_per_column = s_step * views_per_column;
      s_of_column_0 = s_start + (0.5 - lead) * s_per_column;
      half_s = std::abs(s_step) * ((0.5 + beyond) * views_per_column + (lens.continuous ? 0 : 0.5)) + 1e-6;
    } else {
      cells_per_tile = 96;
    }
    // Of the 0.5 px, 1/3 is the distance of a sub-pixel from its pixel's centre. The rest is for the edges of lenses,
    // which are rounded up to whole sub-pixels
    half_patch_px = float((cells_per_patch - 1) * pitch / 6 + 0.5 + 0.02);
  }

  // The offset of a phase, before it is rounded to views. Phases have 2^64 a lens. half_s_of_phases: the largest
  // distance of offsets from their middle, for phases that are `apart`.
  double s_of_phase(const Lens& lens, double phase) const {
    return s_start + s_step * double(lens.views) * std::ldexp(phase, -64);
  }
  double half_s_of_phases(const Lens& lens, double apart) const {
    return std::abs(s_step) * (0.5 * double(lens.views) * std::ldexp(apart, -64) + (lens.continuous ? 0 : 0.5)) + 1e-6;
  }

  int64_t samples() const { return int64_t(kBandRows) * cells_per_tile * lens_columns; }

  // Mean x, in pixels, of the samples at lens column 0 of a cell.
  double cell_x(double cell, double row) const {
    return (cell * pitch - shear * row - origin - lead) / 3 + (by_lens ? 1.0 / 3 : 1.0 / 6);
  }

  // The first sub-pixel of a cell in a row.
  int64_t cell_start(const Lens& lens, int64_t row, int64_t cell) const {
    int64_t m = first_stripe(lens, row, cell);
    if (lead == 0) return m;
    constexpr int64_t kAbove = int64_t(kRowPeriod) << 40;  // keeps remainders positive left of the panel
    auto inside = [&](int64_t at) {
      const uint64_t aside = lens.cells.phases[row % kCellPeriod][(at + kAbove) % kRowPeriod];
      return int64_t(lens.phase_at(row, at) + aside) >= 0;
    };
    while (inside(m - 1)) --m;
    while (!inside(m)) ++m;
    return m;
  }

  // Where the cell would begin if all sub-pixels stood in their stripes: an estimate, corrected by one sub-pixel where
  // the fixed-point phase says so.
  int64_t first_stripe(const Lens& lens, int64_t row, int64_t cell) const {
    if (!by_lens) return cell;
    const int64_t m = int64_t(std::ceil(double(cell) * pitch - shear * double(row) - origin));
    const uint64_t phase = lens.phase_at(row, m);
    return phase < lens.phase_x ? m : phase >> 63 ? m + 1 : m - 1;
  }

  // The cells of all samples whose x + shear / 3 (y - 1/2), in pixels, is in [low, high]: the interval that
  // footprint_columns finds.
  Range cell_range(double low, double high) const {
    const double aside = by_lens ? beyond : 0;
    return {int64_t(std::floor((3 * (low - 0.5) - aside + origin) / pitch - 1e-6)),
            int64_t(std::floor((3 * (high - 0.5) + 2 + aside + origin) / pitch + 1e-6))};
  }

  // The cells that may have samples in the band which starts at row0.
  Range cells_of_band(const Lens& lens, int64_t row0) const {
    const double last_row = double(std::min(row0 + kBandRows, lens.height_px) - 1);
    const double a = shear * double(row0), b = shear * last_row;
    return {int64_t(std::floor((std::min(a, b) + origin) / pitch)) - 1,
            int64_t(std::floor((std::max(a, b) + origin + double(3 * lens.width_px - 1)) / pitch)) + 1};
  }
};

// The sub-pixels of a band that belong to neighbouring cells. In each row they are an interval.
struct LensRun {
  int64_t row0 = 0, rows = 0, first[kBandRows], end[kBandRows];  // sub-pixels of each row, clipped to the panel

  LensRun(const Lens& lens, const LensLayout& layout, int64_t row0_, int64_t cell0, int64_t cells)
      : row0(row0_), rows(std::min<int64_t>(kBandRows, lens.height_px - row0_)) {
    for (int64_t r = 0; r < rows; ++r) {
      first[r] = std::max<int64_t>(layout.cell_start(lens, row0 + r, cell0), 0);
      end[r] = std::min(layout.cell_start(lens, row0 + r, cell0 + cells), 3 * lens.width_px);
    }
  }
  int64_t samples() const {
    int64_t sum = 0;
    for (int64_t r = 0; r < rows; ++r) sum += std::max<int64_t>(end[r] - first[r], 0);
    return sum;
  }
  // The part of the panel that a lattice for this run covers, relative to (x0, y0). Rows without samples do not widen
  // its columns.
  LatticePart part(const Lens& lens, double x0, double y0) const {
    int64_t low = lens.width_px, high = 0;
    for (int64_t r = 0; r < rows; ++r)
      if (first[r] < end[r]) low = std::min(low, first[r] / 3), high = std::max(high, (end[r] - 1) / 3);
    const double a = lens.s_start(), b = a + lens.s_step() * double(lens.views);
    return {float(double(low) + 0.5 - x0),         float(double(high) + 0.5 - x0), float(double(row0) + 0.5 - y0),
            float(double(row0 + rows) - 0.5 - y0), float(std::min(a, b)),          float(std::max(a, b))};
  }
};

// An image of the background alone, its sub-pixels in the order of their places. Which channel a place has repeats over
// the panel, so that a few rows, longer than the image by one period, stand for all.
template <class U>
class Backdrop {
 public:
  // value(channel) is the background in that channel of the image.
  template <class Value>
  Backdrop(const Lens& lens, const Value& value)
      : period_(lens.has_cells ? kRowPeriod : 3),
        rows_(lens.has_cells ? kCellPeriod : 1),
        length_(3 * lens.width_px + period_),
        places_(size_t(rows_ * length_)) {
    for (int64_t row = 0; row < rows_; ++row)
      for (int64_t m = 0; m < length_; ++m) places_[size_t(row * length_ + m)] = value(lens.channel_at(row, m));
  }
  void draw(const LensRun& run, int64_t width_px, U* image) const {
    for (int64_t r = 0; r < run.rows; ++r)
      if (run.first[r] < run.end[r])
        std::memcpy(image + (run.row0 + r) * 3 * width_px + run.first[r],
                    places_.data() + (run.row0 + r) % rows_ * length_ + run.first[r] % period_,
                    size_t(run.end[r] - run.first[r]) * sizeof(U));
  }

 private:
  int64_t period_, rows_, length_;
  std::vector<U> places_;  // [rows, length]
};

}  // namespace lfgs
