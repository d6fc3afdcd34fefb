// Stage plan of the method `sorted`: a counting sort of the panel's sub-pixels by (view, tile), a tile at a time. Read
// which view each sub-pixel shows, writes SubpixelLists. Python sums the counts up to starts between the two passes.
#include <algorithm>
#include <vector>

#include "base/parallel.h"
#include "stages/stages.h"

namespace lfgs {
namespace {

// Call visit(place of its view, code) for the sub-pixels of a tile whose view has a list, in the order of the lists.
template <class Visit>
void for_each_subpixel(const ViewMap& map, const SubpixelTile& tile, const int32_t* places, int64_t index,
                       const Visit& visit) {
  const int64_t across = tile.across(map.width_px);
  const int64_t x0 = index % across * tile.width_px, y0 = index / across * tile.height_px();
  const int columns = int(std::min<int64_t>(tile.width_px, map.width_px - x0));
  const int rows = int(std::min<int64_t>(tile.height_px(), map.height_px - y0));
  for (int column = 0; column < columns; ++column)
    for (int row = 0; row < rows; ++row)
      for (int channel = 0; channel < 3; ++channel) {
        const int64_t view = map.at(y0 + row, x0 + column, channel);
        if (view < 0 || view >= map.views || places[view] < 0) continue;
        visit(places[view], encode_subpixel(tile, {column, row, channel}));
      }
}

// Call body(tile, numbers) for all tiles, where the numbers are a worker's own, one for each view that has lists.
template <class Number, class Body>
void for_each_tile(const ViewMap& map, const SubpixelTile& tile, int64_t views, int threads, const Body& body) {
  std::vector<std::vector<Number>> numbers(size_t(std::max(threads, 1)), std::vector<Number>(size_t(views)));
  parallel_for(tile.count(map.width_px, map.height_px), threads,
               [&](int64_t index, int worker) { body(index, numbers[size_t(worker)]); });
}

}  // namespace

void plan_sorted_count(const ViewMap& map, const SubpixelTile& tile, const int32_t* places, int64_t views,
                       int32_t* counts, int threads) {
  const int64_t tiles = tile.count(map.width_px, map.height_px);
  for_each_tile<int32_t>(map, tile, views, threads, [&](int64_t index, std::vector<int32_t>& mine) {
    std::fill(mine.begin(), mine.end(), 0);
    for_each_subpixel(map, tile, places, index, [&](int32_t place, uint16_t) { ++mine[size_t(place)]; });
    for (int64_t place = 0; place < views; ++place) counts[place * tiles + index] = mine[size_t(place)];
  });
}

void plan_sorted_fill(const ViewMap& map, const SubpixelTile& tile, const int32_t* places, int64_t views,
                      const int64_t* starts, uint16_t* codes, int threads) {
  const int64_t tiles = tile.count(map.width_px, map.height_px);
  for_each_tile<int64_t>(map, tile, views, threads, [&](int64_t index, std::vector<int64_t>& next) {
    for (int64_t place = 0; place < views; ++place) next[size_t(place)] = starts[place * tiles + index];
    for_each_subpixel(map, tile, places, index, [&](int32_t place, uint16_t code) {
      // A table that has changed since it was counted spoils the image, but nothing is written past a list
      if (next[size_t(place)] < starts[place * tiles + index + 1]) codes[next[size_t(place)]++] = code;
    });
    for (int64_t place = 0; place < views; ++place)
      std::fill(codes + next[size_t(place)], codes + starts[place * tiles + index + 1], kNoSubpixel);
  });
}

}  // namespace lfgs
