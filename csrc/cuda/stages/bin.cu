// Stage bin on the device: finds which splats touch which tile. It reads the splats and their order by depth; it writes
// the pairs (tile, splat) and where each tile's pairs begin and end. Splats write their tiles in depth order, and a
// stable sort by tile keeps that order.
#include <cub/device/device_radix_sort.cuh>
#include <cub/device/device_reduce.cuh>
#include <cub/device/device_scan.cuh>
#include <thrust/iterator/counting_iterator.h>
#include <thrust/iterator/transform_iterator.h>

#include <algorithm>
#include <bit>

#include "cuda/common/blend.cuh"
#include "cuda/common/check.h"
#include "cuda/common/count_up.cuh"
#include "cuda/common/gaussian_io.cuh"
#include "cuda/stages/stages.h"
#include "cuda/stages/tile_rows.cuh"

namespace lfgs::cuda {
namespace {

constexpr int kThreads = 128;
constexpr uint32_t kNoTile = ~0u;  // of the room that no pair took; sorts behind all tiles

// Counts the tiles that each splat touches. A thread has a splat.
__global__ void count_kernel(Splats<float> splats, Image image, uint32_t* counts) {
  const int64_t i = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (i >= splats.images * splats.count) return;
  const Splat<float> splat = read_splat(splats.splats + i);
  const TileRows rows(splat, image);
  uint32_t count = 0;
  int tile;
  for (int row = rows.first; row <= rows.last; ++row) count += rows.tiles_of(row, tile);
  counts[i] = count;
}

// The count of the i-th splat; where there are indices, that of the i-th splat in their order.
struct Count {
  const uint32_t *counts, *indices;
  __device__ int64_t operator()(int64_t i) const { return counts[indices ? indices[i] : i]; }
};

// The counts of all splats, for CUB to read.
auto each_count(const uint32_t* counts, const uint32_t* indices = nullptr) {
  return thrust::make_transform_iterator(thrust::counting_iterator<int64_t>(0), Count{counts, indices});
}

// Writes pairs of one splat with `count` tiles from `tile` on, to the slots from `at` on that there is room for.
__device__ void write_pairs(const Pairs& pairs, uint32_t index, uint32_t tile, int count, uint32_t at) {
  for (int k = 0; k < count && at < pairs.count; ++k, ++at) {
    pairs.tiles[at] = tile + k;
    pairs.slot_splats[at] = index;
  }
}

// Writes the pairs of one splat, whose slots begin at `at`, by all lanes of a warp: a lane has a row of tiles.
__device__ void fill_together(const Splats<float>& splats, const Image& image, const Pairs& pairs, uint32_t index,
                              uint32_t first_tile, uint32_t at) {
  const Splat<float> splat = read_splat(splats.splats + index);
  const TileRows rows(splat, image);
  for (int begin = rows.first; begin <= rows.last; begin += 32) {
    const int row = begin + int(threadIdx.x % 32);
    int tile = 0;
    const int count = row <= rows.last ? rows.tiles_of(row, tile) : 0;
    const uint32_t end = sum_to_lane(uint32_t(count));
    write_pairs(pairs, index, first_tile + tile, count, at + end - count);
    at += __shfl_sync(~0u, end, 31);
  }
}

// Writes the pairs in splat-major order, and where the slots of each splat are. A thread has a splat, by depth; a warp
// shares the work for a large one.
__global__ void fill_kernel(Splats<float> splats, Image image, const uint32_t* indices, const int64_t* ends,
                            Pairs pairs, SlotRange* slot_ranges) {
  constexpr uint32_t kFew = 32;
  const int64_t i = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  const bool real = i < splats.images * splats.count;
  const uint32_t index = real ? indices[i] : 0;
  const uint32_t begin = real && i ? uint32_t(min(ends[i - 1], pairs.count)) : 0;
  const uint32_t end = real ? uint32_t(min(ends[i], pairs.count)) : 0;
  if (real) slot_ranges[index] = {begin, end};
  const uint32_t tiles = uint32_t(tile_count(image.tile, image.width_px, image.height_px));
  const uint32_t first_tile = index / uint32_t(splats.count) * tiles;

  if (begin < end && end - begin <= kFew) {
    const Splat<float> splat = read_splat(splats.splats + index);
    const TileRows rows(splat, image);
    uint32_t at = begin;
    for (int row = rows.first; row <= rows.last; ++row) {
      int tile;
      const int count = rows.tiles_of(row, tile);
      write_pairs(pairs, index, first_tile + tile, count, at);
      at += count;
    }
  }
  for (unsigned todo = __ballot_sync(~0u, end - begin > kFew); todo; todo &= todo - 1) {
    const int owner = __ffs(int(todo)) - 1;
    fill_together(splats, image, pairs, __shfl_sync(~0u, index, owner), __shfl_sync(~0u, first_tile, owner),
                  __shfl_sync(~0u, begin, owner));
  }
}

// Writes where each tile's pairs begin and end among the sorted ones, and the splat of each pair. A thread has a pair.
__global__ void ranges_kernel(Pairs pairs, int64_t* ranges) {
  const int64_t i = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (i >= pairs.count) return;
  const uint32_t tile = pairs.sorted_tiles[i];
  if (tile == kNoTile) return;
  if (i == 0 || pairs.sorted_tiles[i - 1] != tile) ranges[2 * int64_t(tile)] = i;
  if (i == pairs.count - 1 || pairs.sorted_tiles[i + 1] != tile) ranges[2 * int64_t(tile) + 1] = i + 1;
  pairs.sorted_splats[i] = pairs.slot_splats[pairs.sorted_slots[i]];
}

}  // namespace

size_t count_bytes(int64_t items) {
  size_t bytes = 0;
  check(cub::DeviceReduce::Sum(nullptr, bytes, each_count(nullptr), (int64_t*)nullptr, items), "bin: size of the sum");
  return bytes;
}

void bin_count(const Splats<float>& splats, const Image& image, uint32_t* counts, int64_t* pairs, void* temporary,
               size_t temporary_bytes, Stream stream) {
  const int64_t items = splats.images * splats.count;
  if (items == 0) return;
  count_kernel<<<unsigned(blocks_for(items, kThreads)), kThreads, 0, cudaStream_t(stream)>>>(splats, image, counts);
  check_launch("bin_count");
  check(cub::DeviceReduce::Sum(temporary, temporary_bytes, each_count(counts), pairs, items, cudaStream_t(stream)),
        "bin: sum");
}

size_t fill_bytes(int64_t items, int64_t pairs) {
  require(pairs < int64_t(1) << 32, std::to_string(pairs) +
                                        " pairs of tile and Gaussian, and at most 2^32 - 1 fit: "
                                        "render fewer or smaller images at a time");
  size_t scan = 0, sort = 0;
  check(cub::DeviceScan::InclusiveSum(nullptr, scan, each_count(nullptr), (int64_t*)nullptr, items),
        "bin: size of the scan");
  check(cub::DeviceRadixSort::SortPairs(nullptr, sort, (uint32_t*)nullptr, (uint32_t*)nullptr, (uint32_t*)nullptr,
                                        (uint32_t*)nullptr, pairs),
        "bin: size of the sort");
  return std::max(scan, sort);
}

void bin_fill(const Splats<float>& splats, const Image& image, const uint32_t* indices, const uint32_t* counts,
              int64_t* ends, const Pairs& pairs, int64_t* ranges, SlotRange* slot_ranges, void* temporary,
              size_t temporary_bytes, Stream stream) {
  const int64_t items = splats.images * splats.count;
  const int64_t all_tiles = image.count * tile_count(image.tile, image.width_px, image.height_px);
  require(all_tiles < int64_t(1) << 32, "more than 2^32 tiles: render fewer or smaller images at a time");
  if (items == 0) return;

  // Where the slots of each splat end, then the pairs
  if (pairs.total)
    check(cudaMemsetAsync(pairs.tiles, 0xff, size_t(pairs.count) * sizeof(kNoTile), cudaStream_t(stream)),
          "bin: tiles");
  check(cub::DeviceScan::InclusiveSum(temporary, temporary_bytes, each_count(counts, indices), ends, items,
                                      cudaStream_t(stream)),
        "bin: scan");
  fill_kernel<<<unsigned(blocks_for(items, kThreads)), kThreads, 0, cudaStream_t(stream)>>>(splats, image, indices,
                                                                                            ends, pairs, slot_ranges);
  check_launch("bin_fill");

  // Sort them by tile, and find the tiles' ranges. The bits of kNoTile are those of no tile
  if (pairs.count == 0) return;
  count_up(pairs.count, pairs.slots, cudaStream_t(stream));
  const int tile_bits = std::max(1, int(std::bit_width(uint64_t(pairs.total ? all_tiles : all_tiles - 1))));
  check(cub::DeviceRadixSort::SortPairs(temporary, temporary_bytes, pairs.tiles, pairs.sorted_tiles, pairs.slots,
                                        pairs.sorted_slots, pairs.count, 0, tile_bits, cudaStream_t(stream)),
        "bin: sort");
  ranges_kernel<<<unsigned(blocks_for(pairs.count, kThreads)), kThreads, 0, cudaStream_t(stream)>>>(pairs, ranges);
  check_launch("bin: ranges");
}

}  // namespace lfgs::cuda
