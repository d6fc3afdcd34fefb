// The panel: which view every sub-pixel shows, and so at which offset its camera stands. The formulas are in
// docs/design.md, "Which view a sub-pixel shows"; lightfield_gs/panels/panel.py is the twin in Python.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <string>
#include <vector>

#include "base/config.h"
#include "base/error.h"

namespace lfgs {

// The sub-pixels of panels that have no stripes. `phases` has the distance of place k of a pixel from stripe k,
// `channels` its channel. Both are by row and column modulo kCellPeriod. Places are numbered in the order in which a
// lens meets them.
constexpr int kCellPeriod = 4, kRowPeriod = 3 * kCellPeriod;  // columns; the same in sub-pixels
struct SubpixelCells {
  uint64_t phases[kCellPeriod][kRowPeriod] = {};  // 2^64 = one lens; to be read as signed
  uint8_t channels[kCellPeriod][kRowPeriod] = {};
};

// A panel with its lens sheet, and the offsets of the cameras behind its views.
struct Lens {
  int64_t width_px = 0, height_px = 0;
  int64_t views = 1;
  uint64_t phase0 = 0, phase_x = 0, phase_y = 0;  // 2^64 = one lens: at the origin, per sub-pixel, per row
  double line_number = 1;                         // P_e: lens width in sub-pixels
  double slant_tan = 0;
  double phase = 0;                          // D_0, sub-pixels
  bool bgr = false;                          // blue is the left-most sub-pixel
  bool continuous = false;                   // cameras at x itself instead of floor(x) + 1/2
  double offset_start = 0, offset_step = 0;  // s = offset_start + offset_step * x, scene units
  bool has_cells = false;
  SubpixelCells cells;

  // The phase of a sub-pixel as if it stood in its stripe.
  LFGS_HD uint64_t phase_at(int64_t row, int64_t subpixel) const {
    return phase0 + phase_x * uint64_t(subpixel) + phase_y * uint64_t(row);
  }
  // The true phase of place k of a pixel, with subpixel = 3 column + k >= 0.
  LFGS_HD uint64_t true_phase(int64_t row, int64_t subpixel) const {
    const uint64_t stripe = phase_at(row, subpixel);
    return has_cells ? stripe + cells.phases[row % kCellPeriod][subpixel % kRowPeriod] : stripe;
  }
  // The image channel that lies there.
  LFGS_HD int channel_at(int64_t row, int64_t subpixel) const {
    if (has_cells) return cells.channels[row % kCellPeriod][subpixel % kRowPeriod];
    return int(bgr ? 2 - subpixel % 3 : subpixel % 3);
  }
  // The sub-pixel of a pixel that has this channel.
  LFGS_HD int64_t subpixel_index(int64_t row, int64_t column, int channel) const {
    int64_t m = 3 * column;
    while (channel_at(row, m) != channel) ++m;
    return m;
  }
  // The largest distance of a sub-pixel from its stripe, in sub-pixels.
  double most_beyond() const;
  // Set phases and channels of the cells, both [kCellPeriod][kRowPeriod]. If they are empty, sub-pixels stand in
  // stripes.
  void set_cells(const std::vector<uint64_t>& phases, const std::vector<int>& channels);
  // Whether the sub-pixels of a row follow each other as their stripes do, each less than one sub-pixel from its own.
  // Then the sub-pixels of a lens lie side by side.
  bool stands_in_order() const;
  // Whether a place has the same channel in all pixels.
  bool has_one_order() const;

  // Largest |s| over x in [0, views].
  LFGS_HD double reach() const {
    double a = offset_start, b = offset_start + offset_step * double(views);
    a = a < 0 ? -a : a;
    b = b < 0 ? -b : b;
    return a > b ? a : b;
  }
  // The normalized offset, in [-1, 1], is s = s_start() + s_step() * x; it is zero on a rig without width.
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

inline void Lens::set_cells(const std::vector<uint64_t>& phases, const std::vector<int>& channels) {
  constexpr size_t kCount = size_t(kCellPeriod) * kRowPeriod;
  require(phases.size() == channels.size() && (phases.empty() || phases.size() == kCount),
          "a lens takes no cells or " + std::to_string(kCount) + " sub-pixels of them");
  has_cells = !phases.empty();
  for (size_t m = 0; m < phases.size(); ++m) {
    require(channels[m] >= 0 && channels[m] < 3, "channels of cells must be 0..2, got " + std::to_string(channels[m]));
    cells.phases[m / kRowPeriod][m % kRowPeriod] = phases[m];
    cells.channels[m / kRowPeriod][m % kRowPeriod] = uint8_t(channels[m]);
  }
}

inline double Lens::most_beyond() const {
  double most = 0;
  for (const auto& row : cells.phases)
    for (uint64_t phase : row) most = std::max(most, std::fabs(double(int64_t(phase))));
  return has_cells ? most * (1.0 / 18446744073709551616.0) * line_number : 0;
}

inline bool Lens::stands_in_order() const {
  if (!has_cells) return true;
  bool in_order = most_beyond() < 1;
  for (const auto& row : cells.phases)
    for (int m = 0; m < kRowPeriod; ++m)
      in_order = in_order && int64_t(row[(m + 1) % kRowPeriod] - row[m] + phase_x) > 0;
  return in_order;
}

inline bool Lens::has_one_order() const {
  bool one = true;
  for (const auto& row : cells.channels)
    for (int m = 0; m < kRowPeriod; ++m) one = one && row[m] == cells.channels[0][m % 3];
  return one;
}

}  // namespace lfgs
