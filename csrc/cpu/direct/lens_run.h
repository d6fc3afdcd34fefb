// Runs of neighbouring cells within a band: which sub-pixels they have, and the background for runs that no splat
// touches. Lattices and the background are drawn run by run.
#pragma once

#include <algorithm>
#include <cstring>
#include <vector>

#include "cpu/direct/lens_layout.h"
#include "math/lattice_plan.h"

namespace lfgs {

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
