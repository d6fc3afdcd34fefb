// Snap ramps of depth to the surfaces on their sides, a texel at a time. lightfield_gs/models/ramps.py says why,
// differentiably. A pass of medians reads one plane of depths and writes another. The first plane of marks has the
// middles of ramps, and later the rows with a snapped texel nearby; the second has the ramps.
#pragma once

#include <utility>

#include "math/photo/sheet.h"

namespace lfgs {

enum RampMark : uint8_t { kOnRamp = 1, kSnapped = 2 };  // in this pass, in any

LFGS_HD bool is_object(const Sheet& sheet, int64_t texel) {
  return sheet.photo[3 * sheet.rows() * sheet.columns() + texel] > sheet.ramps.there;
}

// The smaller size of the steps to both neighbours, `stride` texels off, where both go the same way, else 0.
LFGS_HD float ramp_slope(const Sheet& sheet, const float* depth, int64_t texel, int64_t stride, int64_t at,
                         int64_t count) {
  if (at == 0 || at + 1 >= count) return 0;
  const float ahead = depth[texel + stride] - depth[texel], behind = depth[texel] - depth[texel - stride];
  if (!(ahead * behind > 0) || !is_object(sheet, texel + stride) || !is_object(sheet, texel - stride)) return 0;
  return glm::min(std::abs(ahead), std::abs(behind));
}

struct RampSlopes {
  float across = 0, down = 0;

  LFGS_HD RampSlopes(const Sheet& sheet, const float* depth, int64_t row, int64_t column) {
    const int64_t columns = sheet.columns(), texel = row * columns + column;
    if (!is_object(sheet, texel)) return;
    across = ramp_slope(sheet, depth, texel, 1, column, columns);
    down = ramp_slope(sheet, depth, texel, columns, row, sheet.rows());
  }
};

// Whether a mark is set on the texels of a row or of a column, at most `reach` off.
LFGS_HD bool is_near(const uint8_t* marks, uint8_t mark, int64_t stride, int64_t at, int64_t count, int reach) {
  const int64_t first = glm::max(-int64_t(reach), -at), last = glm::min(int64_t(reach), count - 1 - at);
  for (int64_t k = first; k <= last; ++k)
    if (marks[k * stride] & mark) return true;
  return false;
}

// The passes, for every texel each.
struct MarkSteep {
  const float* depth;

  LFGS_HD void operator()(const Sheet& sheet, int64_t row, int64_t column) const {
    const RampSlopes slopes(sheet, depth, row, column);
    sheet.marks[row * sheet.columns() + column] =
        glm::max(slopes.across, sheet.ramps.down * slopes.down) > sheet.ramps.steep;
  }
};

struct MarkRamps {
  const float* depth;

  LFGS_HD void operator()(const Sheet& sheet, int64_t row, int64_t column) const {
    const int64_t rows = sheet.rows(), columns = sheet.columns(), texel = row * columns + column;
    const RampSlopes slopes(sheet, depth, row, column);
    bool found = false;
    if (glm::max(slopes.across, slopes.down) > sheet.ramps.slope) {
      const int64_t reach = sheet.ramps.reach, last = glm::min(rows - 1, row + reach);
      for (int64_t y = glm::max(int64_t(0), row - reach); y <= last && !found; ++y)
        found = is_near(sheet.marks + y * columns + column, 1, 1, column, columns, int(reach));
    }
    uint8_t& mark = sheet.marks[rows * columns + texel];
    mark = uint8_t(found ? kOnRamp | kSnapped : mark & kSnapped);
  }
};

// Mark texels in rows near a snapped one.
struct MarkAround {
  LFGS_HD void operator()(const Sheet& sheet, int64_t row, int64_t column) const {
    const int64_t columns = sheet.columns(), texel = row * columns + column;
    const uint8_t* snapped = sheet.marks + sheet.rows() * columns + texel;
    sheet.marks[texel] = is_near(snapped, kSnapped, 1, column, columns, sheet.ramps.around);
  }
};

constexpr int kMostNeighbours = 128;  // of a window

// The weighted median of the depths around a texel; neighbours on ramps do not count unless `with_ramps`.
LFGS_HD float median_depth(const Sheet& sheet, const float* depth, const RampWindow& window, bool with_ramps,
                           int64_t row, int64_t column) {
  const int64_t rows = sheet.rows(), columns = sheet.columns(), texel = row * columns + column;
  const uint8_t* ramps = sheet.marks + rows * columns;
  const glm::vec3 own(straight_texel(sheet, texel));
  const float distances = -0.5f / (window.deviation * window.deviation);
  const float differences = -0.5f / (sheet.ramps.similar * sheet.ramps.similar);
  float depths[kMostNeighbours], weights[kMostNeighbours], low = 0, high = 0, half = 0;
  int count = 0;
  for (int v = -window.radius; v <= window.radius; ++v)
    for (int u = -window.radius; u <= window.radius; ++u) {
      const int64_t y = row + v * window.step, x = column + u * window.step, at = y * columns + x;
      if (u * u + v * v > window.radius * window.radius || count == kMostNeighbours) continue;
      if (y < 0 || y >= rows || x < 0 || x >= columns || !is_object(sheet, at)) continue;
      if (!with_ramps && (ramps[at] & kOnRamp)) continue;
      const glm::vec3 other = glm::vec3(straight_texel(sheet, at)) - own;
      const float distance = float((u * u + v * v) * window.step * window.step);
      const float weight =
          (std::exp(differences * glm::dot(other, other)) + window.least) * std::exp(distances * distance);
      depths[count] = depth[at];
      weights[count++] = weight;
      low = count == 1 ? depth[at] : glm::min(low, depth[at]);
      high = count == 1 ? depth[at] : glm::max(high, depth[at]);
      half += weight / 2;
    }
  if (count == 0) return depth[texel];
  // Halve the interval until its upper end is the median, which half of the weight does not exceed
  float below = low - 1;
  for (int k = 0; k < 40 && below < high; ++k) {
    const float middle = below + (high - below) / 2;
    if (!(middle > below && middle < high)) break;
    float sum = 0;
    for (int i = 0; i < count; ++i) sum += depths[i] <= middle ? weights[i] : 0;
    (sum >= half ? high : below) = middle;
  }
  float median = low;
  for (int i = 0; i < count; ++i)
    if (depths[i] <= high) median = glm::max(median, depths[i]);
  return median;
}

struct Snap {
  const float* from;
  float* to;

  LFGS_HD void operator()(const Sheet& sheet, int64_t row, int64_t column) const {
    const int64_t columns = sheet.columns(), texel = row * columns + column;
    const bool is_wanted = sheet.marks[sheet.rows() * columns + texel] & kOnRamp;
    to[texel] = is_wanted ? median_depth(sheet, from, sheet.ramps.snap, false, row, column) : from[texel];
  }
};

// Whether two surfaces are near a texel.
LFGS_HD bool is_at_edge(const Sheet& sheet, const float* depth, int64_t row, int64_t column) {
  const int64_t columns = sheet.columns(), spread = sheet.ramps.spread;
  const int64_t top = glm::max(int64_t(0), row - spread), bottom = glm::min(sheet.rows() - 1, row + spread);
  const int64_t left = glm::max(int64_t(0), column - spread), right = glm::min(columns - 1, column + spread);
  float near = depth[row * columns + column], far = near;
  for (int64_t y = top; y <= bottom; ++y)
    for (int64_t x = left; x <= right; ++x) {
      if (!is_object(sheet, y * columns + x)) continue;
      near = glm::min(near, depth[y * columns + x]);
      far = glm::max(far, depth[y * columns + x]);
    }
  return far - near > sheet.ramps.apart;
}

struct Clean {
  const float* from;
  float* to;

  LFGS_HD void operator()(const Sheet& sheet, int64_t row, int64_t column) const {
    const int64_t columns = sheet.columns(), texel = row * columns + column;
    const bool is_wanted = is_object(sheet, texel) &&
                           is_near(sheet.marks + texel, 1, columns, row, sheet.rows(), sheet.ramps.around) &&
                           is_at_edge(sheet, from, row, column);
    to[texel] = is_wanted ? median_depth(sheet, from, sheet.ramps.clean, true, row, column) : from[texel];
  }
};

struct StoreDisparity {
  const float* depth;

  LFGS_HD void operator()(const Sheet& sheet, int64_t row, int64_t column) const {
    const int64_t texel = row * sheet.columns() + column;
    sheet.surface[texel] = std::exp(-depth[texel] / (float(sheet.factor) * sheet.intrinsics[0]));
  }
};

// Run all passes. for_all(pass) calls pass(sheet, row, column) for every texel; the next pass begins after that.
template <class ForAll>
void snap_ramps(const Sheet& sheet, const ForAll& for_all) {
  float *depth = sheet.surface, *spare = sheet.other;
  for (int k = 0; k < sheet.ramps.snaps; ++k) {
    for_all(MarkSteep{depth});
    for_all(MarkRamps{depth});
    for_all(Snap{depth, spare});
    std::swap(depth, spare);
  }
  for_all(MarkAround{});
  for (int k = 0; k < sheet.ramps.cleans; ++k) {
    for_all(Clean{depth, spare});
    std::swap(depth, spare);
  }
  for_all(StoreDisparity{depth});
}

}  // namespace lfgs
