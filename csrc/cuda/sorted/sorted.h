// The stages of `sorted` on the device, for some views of a panel at a time. Each view is an ordinary camera, and only
// its own sub-pixels are drawn. Gaussians + cameras -> project -> count -> fill -> order -> composite.
//
// Lists are made by counting, not by sorting intersections. count finds the length of the list of every (view, tile),
// fill writes the splats in any order, and order sorts each list by depth. Nothing allocates or waits. Between count
// and fill the caller reads how many intersections there are, and takes memory for them.
#pragma once

#include <cstdint>

#include "base/config.h"
#include "cuda/stages/stages.h"
#include "scene/subpixels.h"

namespace lfgs::cuda {

// The results of count.
struct SortedState {
  unsigned long long intersections;  // (list, splat) intersections
  unsigned long_lists;               // lists of more than kShortList splats
  unsigned drawn;                    // splats drawn, in all views
};

// Views that are drawn together, and where the parts of their work memory are.
struct SortedChunk {
  Image image;    // views, the size of the panel, the tiles
  int64_t count;  // Gaussians N, as many splats in each of V views
  SubpixelTile tile;

  // The state and the ranges lie side by side, so that one call clears both
  SortedState* state = nullptr;
  uint32_t* ranges = nullptr;  // [V * tiles, 2]: first and end of every list among the ids
  size_t cleared_bytes = 0;
  float* footprints = nullptr;     // [V, N, kFootprintNumbers]
  float* colours = nullptr;        // [V, N, kColourStride]
  uint32_t* depths = nullptr;      // [V, N]: the bits of the splats' depths, which are positive
  uint32_t* long_lists = nullptr;  // [V * tiles]: the numbers of the long lists, in any order
  uint32_t* ids = nullptr;         // [intersections]: the splats of all lists; not in the work memory

  // Throws Error when 32 bits do not hold the number of a splat or of a list.
  SortedChunk(int64_t views, int64_t count, int64_t width_px, int64_t height_px, const SubpixelTile& tile);
  int64_t splats() const { return image.count * count; }
  LFGS_HD int64_t tiles() const { return tile_count(image.tile, image.width_px, image.height_px); }
  LFGS_HD int64_t lists() const { return image.count * tiles(); }
  // Lay the parts out in `work` (null: only counts); return the bytes.
  size_t place(void* work);
};

// A splat as these stages keep it: u0, v0, c0, tau, log2 opacity, S^(-1/2), S and reach_y of Splat. The rest of Splat
// is zero for ordinary cameras.
constexpr int kFootprintNumbers = 8;

void project_sorted(const SortedChunk& chunk, const Gaussians<const float>& gaussians, const Cameras<float>& cameras,
                    Stream stream);
void count_sorted(const SortedChunk& chunk, Stream stream);  // then state->intersections is known
void fill_sorted(const SortedChunk& chunk, Stream stream);
void order_sorted(const SortedChunk& chunk, Stream stream);
// Write the sub-pixels of the views to out8, or where that is null to out. The lists are of the chunk's views.
void composite_sorted(const SortedChunk& chunk, const SubpixelLists& lists, const float* background, float* out,
                      uint8_t* out8, Stream stream);

}  // namespace lfgs::cuda
