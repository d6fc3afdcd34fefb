// Stages order and bin on the device. Stage order sorts the splats of all images by the keys (image, depth) that
// project wrote, in one stable radix sort, and writes their indices. Stage bin finds which splats touch which tile. It
// reads the splats and their order; it writes the intersections (tile, splat) and where each tile's intersections begin
// and end. Splats write their tiles in depth order, and a stable sort by tile keeps that order.
#include <cub/device/device_radix_sort.cuh>
#include <cub/device/device_reduce.cuh>
#include <cub/device/device_scan.cuh>
#include <thrust/iterator/counting_iterator.h>
#include <thrust/iterator/transform_iterator.h>

#include <algorithm>
#include <bit>

#include "cuda/common/blend.cuh"
#include "cuda/common/launch.h"
#include "cuda/common/gaussian_io.cuh"
#include "cuda/stages/stages.h"
#include "cuda/stages/tile_rows.cuh"

namespace lfgs::cuda {
namespace {

constexpr int kThreads = 128;
constexpr uint32_t kNoTile = ~0u;  // of unused capacity; sorts behind all tiles

// Count the tiles that each splat touches. A thread has a splat.
__global__ void count_kernel(Splats<float> splats, Image image, uint32_t* counts) {
  const int64_t i = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (i >= splats.images * splats.count) return;
  const Splat<float> splat = read_splat(splats.splats + i);
  const TileRows rows(splat, image);
  uint32_t count = 0;
  int tile;
  for (int row = rows.first; row <= rows.last; ++row) count += rows.tiles_in(row, tile);
  counts[i] = count;
}

// The count of the i-th splat, or with indices of the i-th splat in their order.
struct Count {
  const uint32_t *counts, *indices;
  __device__ int64_t operator()(int64_t i) const { return counts[indices ? indices[i] : i]; }
};

// The counts of all splats, for CUB to read.
auto each_count(const uint32_t* counts, const uint32_t* indices = nullptr) {
  return thrust::make_transform_iterator(thrust::counting_iterator<int64_t>(0), Count{counts, indices});
}

// Write the intersections of one splat with `count` tiles from `tile` on, to the indices from `at` on, up to the
// capacity.
__device__ void write_intersections(const Intersections& intersections, uint32_t index, uint32_t tile, int count,
                                    uint32_t at) {
  for (int k = 0; k < count && at < intersections.count; ++k, ++at) {
    intersections.tiles[at] = tile + k;
    intersections.splats[at] = index;
  }
}

// Write the intersections of one splat from index `at` on, by all lanes of a warp: a lane has a row of tiles.
__device__ void fill_together(const Splats<float>& splats, const Image& image, const Intersections& intersections,
                              uint32_t index, uint32_t first_tile, uint32_t at) {
  const Splat<float> splat = read_splat(splats.splats + index);
  const TileRows rows(splat, image);
  for (int begin = rows.first; begin <= rows.last; begin += 32) {
    const int row = begin + int(threadIdx.x % 32);
    int tile = 0;
    const int count = row <= rows.last ? rows.tiles_in(row, tile) : 0;
    const uint32_t end = sum_to_lane(uint32_t(count));
    write_intersections(intersections, index, first_tile + tile, count, at + end - count);
    at += __shfl_sync(~0u, end, 31);
  }
}

// Write the intersections in splat-major order, and where the intersections of each splat are. A thread has a splat,
// by depth; a warp shares the work for a large one.
__global__ void fill_kernel(Splats<float> splats, Image image, const uint32_t* indices, const int64_t* ends,
                            Intersections intersections, IntersectionRange* intersection_ranges) {
  constexpr uint32_t kFew = 32;
  const int64_t i = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  const bool real = i < splats.images * splats.count;
  const uint32_t index = real ? indices[i] : 0;
  const uint32_t begin = real && i ? uint32_t(min(ends[i - 1], intersections.count)) : 0;
  const uint32_t end = real ? uint32_t(min(ends[i], intersections.count)) : 0;
  if (real) intersection_ranges[index] = {begin, end};
  const uint32_t tiles = uint32_t(tile_count(image.tile, image.width_px, image.height_px));
  const uint32_t first_tile = index / uint32_t(splats.count) * tiles;

  if (begin < end && end - begin <= kFew) {
    const Splat<float> splat = read_splat(splats.splats + index);
    const TileRows rows(splat, image);
    uint32_t at = begin;
    for (int row = rows.first; row <= rows.last; ++row) {
      int tile;
      const int count = rows.tiles_in(row, tile);
      write_intersections(intersections, index, first_tile + tile, count, at);
      at += count;
    }
  }
  for (unsigned todo = __ballot_sync(~0u, end - begin > kFew); todo; todo &= todo - 1) {
    const int owner = __ffs(int(todo)) - 1;
    fill_together(splats, image, intersections, __shfl_sync(~0u, index, owner), __shfl_sync(~0u, first_tile, owner),
                  __shfl_sync(~0u, begin, owner));
  }
}

// Write where each tile's intersections begin and end among the sorted ones, and the splat of each intersection. A
// thread has an intersection.
__global__ void ranges_kernel(Intersections intersections, int64_t* ranges) {
  const int64_t i = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (i >= intersections.count) return;
  const uint32_t tile = intersections.sorted_tiles[i];
  if (tile == kNoTile) return;
  if (i == 0 || intersections.sorted_tiles[i - 1] != tile) ranges[2 * int64_t(tile)] = i;
  if (i == intersections.count - 1 || intersections.sorted_tiles[i + 1] != tile) ranges[2 * int64_t(tile) + 1] = i + 1;
  intersections.sorted_splats[i] = intersections.splats[intersections.sorted_indices[i]];
}

// Write 0, 1, 2, ..., the indices that a sort moves with the keys. A thread has a number.
__global__ void count_up_kernel(int64_t items, uint32_t* numbers) {
  const int64_t i = int64_t(blockIdx.x) * blockDim.x + threadIdx.x;
  if (i < items) numbers[i] = uint32_t(i);
}

void count_up(int64_t items, uint32_t* numbers, cudaStream_t stream) {
  constexpr int kThreads = 256;
  if (items == 0) return;
  count_up_kernel<<<unsigned(blocks_for(items, kThreads)), kThreads, 0, stream>>>(items, numbers);
  check_launch("count_up");
}

}  // namespace

// The temporary storage also holds the unsorted indices, at its end.
size_t order_bytes(int64_t items) {
  size_t bytes = 0;
  check(cub::DeviceRadixSort::SortPairs(nullptr, bytes, (uint64_t*)nullptr, (uint64_t*)nullptr, (uint32_t*)nullptr,
                                        (uint32_t*)nullptr, items),
        "order: size of the sort");
  return (bytes + 255) / 256 * 256 + size_t(items) * sizeof(uint32_t);
}

void order(int64_t items, int64_t images, const uint64_t* keys, uint64_t* sorted_keys, uint32_t* indices,
           void* temporary, size_t temporary_bytes, Stream stream) {
  if (items == 0) return;
  require(items < int64_t(1) << 32, "more than 2^32 Gaussians in all images: render fewer images at a time");
  size_t bytes = temporary_bytes - size_t(items) * sizeof(uint32_t);
  uint32_t* unsorted = reinterpret_cast<uint32_t*>(static_cast<char*>(temporary) + bytes);
  count_up(items, unsorted, cudaStream_t(stream));
  // Splats that are not drawn have all bits of their keys set. Sorting by one bit more than image numbers need puts
  // them last
  const int end_bit = kDepthBits + int(std::bit_width(uint64_t(images)));
  check(cub::DeviceRadixSort::SortPairs(temporary, bytes, keys, sorted_keys, unsorted, indices, items, 0, end_bit,
                                        cudaStream_t(stream)),
        "order");
}

size_t count_bytes(int64_t items) {
  size_t bytes = 0;
  check(cub::DeviceReduce::Sum(nullptr, bytes, each_count(nullptr), (int64_t*)nullptr, items), "bin: size of the sum");
  return bytes;
}

void bin_count(const Splats<float>& splats, const Image& image, uint32_t* counts, int64_t* intersections,
               void* temporary, size_t temporary_bytes, Stream stream) {
  const int64_t items = splats.images * splats.count;
  if (items == 0) return;
  count_kernel<<<unsigned(blocks_for(items, kThreads)), kThreads, 0, cudaStream_t(stream)>>>(splats, image, counts);
  check_launch("bin_count");
  check(cub::DeviceReduce::Sum(temporary, temporary_bytes, each_count(counts), intersections, items,
                               cudaStream_t(stream)),
        "bin: sum");
}

size_t fill_bytes(int64_t items, int64_t intersections) {
  require(intersections < int64_t(1) << 32, std::to_string(intersections) +
                                                " intersections of tile and Gaussian, and at most 2^32 - 1 fit: "
                                                "render fewer or smaller images at a time");
  size_t scan = 0, sort = 0;
  check(cub::DeviceScan::InclusiveSum(nullptr, scan, each_count(nullptr), (int64_t*)nullptr, items),
        "bin: size of the scan");
  check(cub::DeviceRadixSort::SortPairs(nullptr, sort, (uint32_t*)nullptr, (uint32_t*)nullptr, (uint32_t*)nullptr,
                                        (uint32_t*)nullptr, intersections),
        "bin: size of the sort");
  return std::max(scan, sort);
}

void bin_fill(const Splats<float>& splats, const Image& image, const uint32_t* indices, const uint32_t* counts,
              int64_t* ends, const Intersections& intersections, int64_t* ranges,
              IntersectionRange* intersection_ranges, void* temporary, size_t temporary_bytes, Stream stream) {
  const int64_t items = splats.images * splats.count;
  const int64_t all_tiles = image.count * tile_count(image.tile, image.width_px, image.height_px);
  require(all_tiles < int64_t(1) << 32, "more than 2^32 tiles: render fewer or smaller images at a time");
  if (items == 0) return;

  // Where the intersections of each splat end, then the intersections
  if (intersections.total)
    check(
        cudaMemsetAsync(intersections.tiles, 0xff, size_t(intersections.count) * sizeof(kNoTile), cudaStream_t(stream)),
        "bin: tiles");
  check(cub::DeviceScan::InclusiveSum(temporary, temporary_bytes, each_count(counts, indices), ends, items,
                                      cudaStream_t(stream)),
        "bin: scan");
  fill_kernel<<<unsigned(blocks_for(items, kThreads)), kThreads, 0, cudaStream_t(stream)>>>(
      splats, image, indices, ends, intersections, intersection_ranges);
  check_launch("bin_fill");

  // Sort them by tile, and find the tiles' ranges. No tile has the bits of kNoTile
  if (intersections.count == 0) return;
  count_up(intersections.count, intersections.indices, cudaStream_t(stream));
  const int tile_bits = std::max(1, int(std::bit_width(uint64_t(intersections.total ? all_tiles : all_tiles - 1))));
  check(cub::DeviceRadixSort::SortPairs(temporary, temporary_bytes, intersections.tiles, intersections.sorted_tiles,
                                        intersections.indices, intersections.sorted_indices, intersections.count, 0,
                                        tile_bits, cudaStream_t(stream)),
        "bin: sort");
  ranges_kernel<<<unsigned(blocks_for(intersections.count, kThreads)), kThreads, 0, cudaStream_t(stream)>>>(
      intersections, ranges);
  check_launch("bin: ranges");
}

}  // namespace lfgs::cuda
