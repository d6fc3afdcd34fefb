// Stage bin on the device: which splats touch which tile. Splats write their tiles in depth order; a stable sort by
// tile keeps it.
#include <cub/device/device_radix_sort.cuh>
#include <cub/device/device_scan.cuh>

#include <algorithm>
#include <bit>

#include "cuda/check.h"
#include "cuda/stages.h"
#include "math/footprint.h"

namespace lfgs::cuda {
namespace {

constexpr int kThreads = 128;

// Calls visit(tile) for the tiles of its image that a splat may touch.
template <class Visit>
__device__ void for_each_tile(const Splat<float>& splat, const Image& image, const Visit& visit) {
  const Range rows = rows_of(splat, image.height_px);
  if (rows.last < rows.first) return;
  const int64_t across = (image.width_px + image.tile.width_px - 1) / image.tile.width_px;
  for (int64_t down = rows.first / image.tile.height_px; down <= rows.last / image.tile.height_px; ++down) {
    const float top = float(down * image.tile.height_px) + 0.5f;
    float low, high;
    if (!columns_of(splat, top, top + float(image.tile.height_px - 1), 0.f, low, high)) continue;
    const Range columns = pixels_within(low, high, image.width_px);
    if (columns.last < columns.first) continue;
    for (int64_t tile = columns.first / image.tile.width_px; tile <= columns.last / image.tile.width_px; ++tile)
      visit(down * across + tile);
  }
}

__global__ void count_kernel(Splats<float> splats, Image image, const uint64_t* keys, const uint32_t* indices,
                             int64_t* counts) {
  const int64_t i = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (i >= splats.images * splats.count) return;
  int64_t count = 0;
  if (keys[i] != ~uint64_t(0)) for_each_tile(splats.splats[indices[i]], image, [&](int64_t) { ++count; });
  counts[i] = count;
}

__global__ void fill_kernel(Splats<float> splats, Image image, const uint64_t* keys, const uint32_t* indices,
                            const int64_t* ends, Pairs pairs) {
  const int64_t i = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (i >= splats.images * splats.count || keys[i] == ~uint64_t(0)) return;
  const int64_t first_tile = int64_t(keys[i] >> 32) * tile_count(image.tile, image.width_px, image.height_px);
  int64_t at = i ? ends[i - 1] : 0;
  for_each_tile(splats.splats[indices[i]], image, [&](int64_t tile) {
    pairs.tiles[at] = uint32_t(first_tile + tile);
    pairs.slots[at] = uint32_t(at);
    pairs.slot_splats[at++] = indices[i];
  });
}

__global__ void ranges_kernel(int64_t pairs, const uint32_t* sorted_tiles, int64_t* ranges) {
  const int64_t i = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (i >= pairs) return;
  const uint32_t tile = sorted_tiles[i];
  if (i == 0 || sorted_tiles[i - 1] != tile) ranges[2 * int64_t(tile)] = i;
  if (i == pairs - 1 || sorted_tiles[i + 1] != tile) ranges[2 * int64_t(tile) + 1] = i + 1;
}

}  // namespace

size_t count_bytes(int64_t items) {
  size_t bytes = 0;
  check(cub::DeviceScan::InclusiveSum(nullptr, bytes, (int64_t*)nullptr, (int64_t*)nullptr, items),
        "bin: size of the scan");
  return bytes;
}

void bin_count(const Splats<float>& splats, const Image& image, const uint64_t* sorted_keys, const uint32_t* indices,
               int64_t* ends, void* temporary, size_t temporary_bytes, Stream stream) {
  const int64_t items = splats.images * splats.count;
  if (items == 0) return;
  count_kernel<<<unsigned(blocks_for(items, kThreads)), kThreads, 0, cudaStream_t(stream)>>>(splats, image, sorted_keys,
                                                                                            indices, ends);
  check_launch("bin_count");
  check(cub::DeviceScan::InclusiveSum(temporary, temporary_bytes, ends, ends, items, cudaStream_t(stream)),
        "bin: scan");
}

size_t fill_bytes(int64_t pairs) {
  size_t bytes = 0;
  check(cub::DeviceRadixSort::SortPairs(nullptr, bytes, (uint32_t*)nullptr, (uint32_t*)nullptr, (uint32_t*)nullptr,
                                        (uint32_t*)nullptr, pairs),
        "bin: size of the sort");
  return bytes;
}

void bin_fill(const Splats<float>& splats, const Image& image, const uint64_t* sorted_keys, const uint32_t* indices,
              const int64_t* ends, const Pairs& pairs, int64_t* ranges, void* temporary, size_t temporary_bytes,
              Stream stream) {
  if (pairs.count == 0) return;
  const int64_t items = splats.images * splats.count;
  const int64_t all_tiles = image.count * tile_count(image.tile, image.width_px, image.height_px);
  require(pairs.count < (int64_t(1) << 32) && all_tiles < (int64_t(1) << 32),
          "more than 2^32 pairs or tiles: render fewer or smaller images at a time");
  fill_kernel<<<unsigned(blocks_for(items, kThreads)), kThreads, 0, cudaStream_t(stream)>>>(splats, image, sorted_keys,
                                                                                           indices, ends, pairs);
  check_launch("bin_fill");
  check(cub::DeviceRadixSort::SortPairs(temporary, temporary_bytes, pairs.tiles, pairs.sorted_tiles, pairs.slots,
                                        pairs.sorted_slots, pairs.count, 0,
                                        std::max(1, int(std::bit_width(uint64_t(all_tiles - 1)))),
                                        cudaStream_t(stream)),
        "bin: sort");
  ranges_kernel<<<unsigned(blocks_for(pairs.count, kThreads)), kThreads, 0, cudaStream_t(stream)>>>(
      pairs.count, pairs.sorted_tiles, ranges);
  check_launch("bin: ranges");
}

}  // namespace lfgs::cuda
