// The stages and their reverses on a CUDA device: the CPU's stages (stages/stages.h) with device pointers and a
// stream. Nothing here allocates or waits; the caller asks for the sizes of temporary storage first.
#pragma once

#include <cstdint>

#include "base/config.h"
#include "math/gradient_sums.h"
#include "stages/stages.h"

namespace lfgs::cuda {

using Stream = void*;  // cudaStream_t

// Tiles of the device's lists: pixels across and down.
struct TileSize {
  int width_px, height_px;
};
constexpr TileSize kDenseTile{16, 16}, kLensTile{32, 16};

LFGS_HD int64_t tile_count(TileSize tile, int64_t width_px, int64_t height_px) {
  return ((width_px + tile.width_px - 1) / tile.width_px) * ((height_px + tile.height_px - 1) / tile.height_px);
}

struct Image {
  int64_t count, width_px, height_px;  // of images, all of one size
  TileSize tile;
};

// --- project: also writes the sort keys [I * N]: the image above kDepthBits bits of depth, which is positive; ~0 where
// nothing is drawn.
constexpr int kDepthBits = 31;
constexpr int64_t kMostImages = 65535;  // blocks of a launch, down
void project_dense(const Gaussians<const float>& gaussians, const Cameras<float>& cameras, const Splats<float>& out,
                   uint64_t* keys, Stream stream);
// error receives the largest estimated error of a colour polynomial (one float, zeroed by the caller).
void project_lens(const Gaussians<const float>& gaussians, const View<double>& rig, const Lens& lens, double tolerance,
                  const Splats<float>& out, uint64_t* keys, float* error, Stream stream);

// --- order: indices [I * N] sorted by key. Raises when 32 bits do not hold an index.
size_t order_bytes(int64_t items);
void order(int64_t items, int64_t images, const uint64_t* keys, uint64_t* sorted_keys, uint32_t* indices,
           void* temporary, size_t temporary_bytes, Stream stream);

// --- bin: count writes, per splat, how many (tile, splat) pairs it has: counts [I * N]; and how many there are of all:
// pairs (one number). It needs no order, so that the host may learn the latter while the device sorts.
size_t count_bytes(int64_t items);
void bin_count(const Splats<float>& splats, const Image& image, uint32_t* counts, int64_t* pairs, void* temporary,
               size_t temporary_bytes, Stream stream);
// Buffers of fill, a number per pair. A *slot* is the place of a pair in splat-major order: those of the i-th sorted
// splat are [ends[i - 1], ends[i]). Only what is sorted is of use after fill.
struct Pairs {
  int64_t count;
  uint32_t *tiles, *sorted_tiles;         // tile of each slot; of each sorted pair
  uint32_t *slots, *sorted_slots;         // 0, 1, 2, ...; the slot of each sorted pair
  uint32_t *slot_splats, *sorted_splats;  // splat of each slot; of each sorted pair
};
// The splat of the k-th pair in the order of `ranges`.
LFGS_HD uint32_t splat_of(const Pairs& pairs, int64_t k) { return pairs.sorted_splats[k]; }
// The slots of one splat, [first, last).
struct SlotRange {
  uint32_t first, last;
};
// fill writes the pairs, nearest first within a tile, their running number per sorted splat: ends [I * N], ranges
// [I * tiles, 2] into them (zeroed by the caller: empty tiles are left alone) and slot_ranges [I * N]. fill_bytes
// raises when 32 bits do not hold a slot.
size_t fill_bytes(int64_t items, int64_t pairs);
void bin_fill(const Splats<float>& splats, const Image& image, const uint32_t* indices, const uint32_t* counts,
              int64_t* ends, const Pairs& pairs, int64_t* ranges, SlotRange* slot_ranges, void* temporary,
              size_t temporary_bytes, Stream stream);

// --- composite
void composite_dense(const Splats<float>& splats, const Image& image, const int64_t* ranges, const Pairs& pairs,
                     const float* background, DenseImages<float> out, Stream stream);
void composite_lens(const Splats<float>& splats, const Image& image, const int64_t* ranges, const Pairs& pairs,
                    const Lens& lens, const float* background, float* out, Stream stream);
// order [image.count * tiles]: the (view, tile) lists by falling work. Writes to out, or where that is null to out8.
void composite_sorted(const Splats<float>& splats, const Image& image, const int64_t* ranges, const Pairs& pairs,
                      const SubpixelLists& lists, const int64_t* order, const float* background, float* out,
                      uint8_t* out8, Stream stream);

// --- the reverses. Every slot is written by one block in a fixed order, and sums run in slot order: the same
// bits in every run. slot_gradients [pairs, numbers of a slot]; tile_background [I * tiles, 3].
//
// Numbers of a slot: of ordinary images, the first kDenseFootprintSums of FootprintSum, then the gradients of depth, r,
// g and b. Of the lens all of FootprintSum, those of r, g, b for each power of s, and of an anti-aliased scene those of
// D.
constexpr int kDepthSum = kDenseFootprintSums, kColourSum = kDepthSum + 1, kDenseSums = kColourSum + 3;
constexpr int kLensSums = kLensFootprintSums;
void composite_dense_backward(const Splats<float>& splats, const Image& image, const int64_t* ranges,
                              const Pairs& pairs, DenseImages<const float> images, DenseImages<const float> gradients,
                              float* slot_gradients, float* tile_background, Stream stream);
// out is written whole, but added to in its harmonics; view_partials [I, view_blocks(N), 12]: rows of [R|t], to be
// summed over the blocks.
int64_t view_blocks(int64_t gaussians);
void project_dense_backward(const Gaussians<const float>& gaussians, const Cameras<float>& cameras,
                            const Splats<float>& splats, const SlotRange* slot_ranges, const float* slot_gradients,
                            const Gaussians<float>& out, float* view_partials, Stream stream);

void composite_lens_backward(const Splats<float>& splats, const Image& image, const int64_t* ranges, const Pairs& pairs,
                             const Lens& lens, const float* pixels, const float* gradient, float* slot_gradients,
                             float* tile_background, Stream stream);
void project_lens_backward(const Gaussians<const float>& gaussians, const View<double>& rig,
                           const Splats<float>& splats, const SlotRange* slot_ranges, const float* slot_gradients,
                           const Gaussians<float>& out, Stream stream);

}  // namespace lfgs::cuda
