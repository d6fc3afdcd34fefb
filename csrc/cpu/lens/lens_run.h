// The sub-pixels of some cells side by side, and how they look where nothing is drawn.
#pragma once

#include <algorithm>
#include <cstring>
#include <vector>

#include "cpu/lens/lens_layout.h"
#include "math/lattice_plan.h"

namespace lfgs {

// The sub-pixels of a band of rows that belong to some cells: those of a row lie side by side.
struct LensRun {
  int64_t row0 = 0, rows = 0, first[kBandRows], end[kBandRows];  // of each row, within the panel

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
  // Columns of sample centres, about x0, y0; what has no samples is skipped.
  LatticePart part(const Lens& lens, double x0, double y0) const {
    int64_t low = lens.width_px, high = 0;
    for (int64_t r = 0; r < rows; ++r)
      if (first[r] < end[r]) low = std::min(low, first[r] / 3), high = std::max(high, (end[r] - 1) / 3);
    const double a = lens.s_start(), b = a + lens.s_step() * double(lens.views);
    return {float(double(low) + 0.5 - x0),         float(double(high) + 0.5 - x0), float(double(row0) + 0.5 - y0),
            float(double(row0 + rows) - 0.5 - y0), float(std::min(a, b)),          float(std::max(a, b))};
  }
};

// Sub-pixels by their places, all of the background.
template <class U>
class Backdrop {
 public:
  // value(channel) of the image.
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
