// List the splats of a band that touch each of its tiles, in the given order, by a counting sort. Its memory is reused
// from band to band.
#pragma once

#include <cstdint>
#include <vector>

#include "math/footprint.h"

namespace lfgs {

class TileLists {
 public:
  // tile_range(id) returns a Range of tiles within [0, tiles). fetch(id) is called some splats earlier, to ask for
  // memory.
  template <class TilesOf, class Fetch>
  void build(const int32_t* ids, int64_t count, int64_t tiles, const TilesOf& tile_range, const Fetch& fetch) {
    // Count the splats of each tile, and remember the tiles of each splat
    ranges_.resize(size_t(count));
    offsets_.assign(size_t(tiles) + 1, 0);
    for (int64_t k = 0; k < count; ++k) {
      if (k + kAhead < count) fetch(ids[k + kAhead]);
      const Range r = tile_range(ids[k]);
      ranges_[k] = {int32_t(r.first), int32_t(r.last)};
      for (int64_t t = r.first; t <= r.last; ++t) ++offsets_[t + 1];
    }

    // Where each tile's list begins, then the lists
    for (int64_t t = 0; t < tiles; ++t) offsets_[t + 1] += offsets_[t];
    next_.assign(offsets_.begin(), offsets_.end() - 1);
    splats_.resize(size_t(offsets_[tiles]));
    for (int64_t k = 0; k < count; ++k)
      for (int32_t t = ranges_[k].first; t <= ranges_[k].last; ++t) splats_[next_[t]++] = ids[k];
  }

  template <class TilesOf>
  void build(const int32_t* ids, int64_t count, int64_t tiles, const TilesOf& tile_range) {
    build(ids, count, tiles, tile_range, [](int32_t) {});
  }

  const int32_t* begin(int64_t tile) const { return splats_.data() + offsets_[tile]; }
  const int32_t* end(int64_t tile) const { return splats_.data() + offsets_[tile + 1]; }
  int64_t intersections() const { return int64_t(splats_.size()); }
  int64_t bytes() const {
    return int64_t(ranges_.capacity() * sizeof(Tiles) + (offsets_.capacity() + next_.capacity()) * sizeof(int64_t) +
                   splats_.capacity() * sizeof(int32_t));
  }

 private:
  static constexpr int64_t kAhead = 8;
  struct Tiles {
    int32_t first, last;
  };
  std::vector<Tiles> ranges_;
  std::vector<int64_t> offsets_, next_;
  std::vector<int32_t> splats_;
};

}  // namespace lfgs
