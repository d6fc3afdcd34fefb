#include "cuda/depth_sort.h"

#include <algorithm>

#include "cuda/check.h"
#include "cuda/look_back.cuh"

namespace lfgs::cuda {
namespace {

// Tiles as small as this are many enough for a large GPU, and each digit's items of one still fill a sector.
constexpr int kThreads = kDigits, kWarps = kThreads / 32, kItems = 8, kTile = kThreads * kItems;
constexpr int kAtOnce = 8;  // words that a thread looks back through: one after the other their latencies would add up

// A word: a number above a tag, which is odd for one tile and even for all up to it. Those of earlier passes are lower,
// so that words need not be cleared between passes.
constexpr int kTagBits = 4;
constexpr uint64_t kTags = (1 << kTagBits) - 1;
static_assert(2 * kPasses <= kTags);

__device__ int digit_of(uint32_t key, int pass) { return int(key >> 8 * pass & (kDigits - 1)); }

__global__ void __launch_bounds__(kThreads) count_kernel(const uint32_t* keys, int64_t items, unsigned* counts) {
  __shared__ unsigned mine[kPasses][kDigits];
  for (int pass = 0; pass < kPasses; ++pass) mine[pass][threadIdx.x] = 0;
  __syncthreads();
  for (int64_t first = int64_t(blockIdx.x) * kTile; first < items; first += int64_t(gridDim.x) * kTile) {
    uint32_t key[kItems];
#pragma unroll
    for (int k = 0; k < kItems; ++k) {
      const int64_t i = first + k * kThreads + threadIdx.x;
      key[k] = i < items ? keys[i] : 0;
    }
#pragma unroll
    for (int k = 0; k < kItems; ++k) {
      if (first + k * kThreads + threadIdx.x >= items) break;
      for (int pass = 0; pass < kPasses; ++pass) atomicAdd(&mine[pass][digit_of(key[k], pass)], 1u);
    }
  }
  __syncthreads();
  for (int pass = 0; pass < kPasses; ++pass)
    if (const unsigned count = mine[pass][threadIdx.x]) atomicAdd(counts + pass * kDigits + threadIdx.x, count);
}

// Items with a thread's digit in the tiles before this one; see look_back.cuh.
__device__ int64_t digit_before(const volatile uint64_t* words, int64_t tile, uint64_t of_tile) {
  int64_t sum = 0;
  while (tile > 0) {
    uint64_t seen[kAtOnce];
#pragma unroll
    for (int k = 0; k < kAtOnce; ++k)
      seen[k] = tile - 1 - k < 0 ? of_tile + 1 : words[(tile - 1 - k) * kDigits + threadIdx.x];
    bool known = true;
#pragma unroll
    for (int k = 0; k < kAtOnce; ++k) {
      known = known && tile > 0 && (seen[k] & kTags) >= of_tile;
      if (known) sum += int64_t(seen[k] >> kTagBits), tile = (seen[k] & kTags) == of_tile ? tile - 1 : 0;
    }
  }
  return sum;
}

// Lanes of the warp with the same digit.
__device__ unsigned peers_of(int digit) {
  unsigned peers = ~0u;
#pragma unroll
  for (int bit = 0; bit < 8; ++bit) {
    const unsigned set = __ballot_sync(~0u, digit >> bit & 1);
    peers &= digit >> bit & 1 ? set : ~set;
  }
  return peers;
}

// A thread has every 32nd item of its warp's part of the tile, and then a digit. In the first pass items are numbered.
__global__ void __launch_bounds__(kThreads, 4) pass_kernel(DepthSort sort, int pass, int64_t items,
                                                           const uint32_t* keys, const uint32_t* order,
                                                           uint32_t* sorted_keys, uint32_t* sorted_order) {
  __shared__ unsigned found[kWarps][kDigits];  // items of a warp with a digit; then, where they begin in the tile's
  __shared__ unsigned begin[kDigits];          // where the tile's items with a digit go
  __shared__ unsigned warps[kWarps], tile_of_block;
  const int warp = threadIdx.x / 32, lane = threadIdx.x % 32;
  if (threadIdx.x == 0) tile_of_block = atomicAdd(sort.next_tile + pass, 1u);
  for (int w = 0; w < kWarps; ++w) found[w][threadIdx.x] = 0;
  const int64_t of_digit = sort.counts[pass * kDigits + threadIdx.x], to_digit = sum_to_lane(of_digit);
  if (lane == 31) warps[warp] = unsigned(to_digit);
  __syncthreads();
  const int64_t tile = tile_of_block, first = tile * kTile + warp * 32 * kItems + lane;

  uint32_t key[kItems], item[kItems];
  unsigned rank[kItems];  // among the warp's items with its digit
#pragma unroll
  for (int k = 0; k < kItems; ++k) {
    const int64_t i = first + 32 * k;
    key[k] = i < items ? keys[i] : ~0u;
    item[k] = pass && i < items ? order[i] : uint32_t(i);
  }
#pragma unroll
  for (int k = 0; k < kItems; ++k) {
    const int digit = digit_of(key[k], pass);
    const unsigned peers = peers_of(digit), before = peers & ((1u << lane) - 1);
    rank[k] = found[warp][digit] + __popc(before);
    __syncwarp();
    if (before == 0) found[warp][digit] += __popc(peers);
    __syncwarp();
  }
  __syncthreads();

  // What fills the last tile comes last in it, so that it moves nothing
  unsigned count = 0;
  for (int w = 0; w < kWarps; ++w) {
    const unsigned of_warp = found[w][threadIdx.x];
    found[w][threadIdx.x] = count, count += of_warp;
  }
  volatile uint64_t* words = sort.words;
  const uint64_t of_tile = 2 * pass + 1, at = tile * kDigits + threadIdx.x;
  words[at] = uint64_t(count) << kTagBits | of_tile;
  const int64_t before = digit_before(words, tile, of_tile);
  words[at] = uint64_t(before + count) << kTagBits | (of_tile + 1);
  int64_t start = before + to_digit - of_digit;
  for (int w = 0; w < warp; ++w) start += warps[w];
  begin[threadIdx.x] = unsigned(start);
  __syncthreads();

#pragma unroll
  for (int k = 0; k < kItems; ++k) {
    if (first + 32 * k >= items) break;
    const int digit = digit_of(key[k], pass);
    const unsigned to = begin[digit] + found[warp][digit] + rank[k];
    sorted_keys[to] = key[k], sorted_order[to] = item[k];
  }
}

}  // namespace

int64_t depth_sort_tiles(int64_t items) { return blocks_for(items, kTile); }

void sort_by_depth(const DepthSort& sort, int64_t items, uint32_t* keys, uint32_t* order, uint32_t* spare_keys,
                   uint32_t* spare_order, Stream stream) {
  const int64_t tiles = depth_sort_tiles(items);
  if (tiles == 0) return;
  const int64_t blocks = std::min<int64_t>(resident_blocks(count_kernel, kThreads, 0), tiles);
  count_kernel<<<unsigned(blocks), kThreads, 0, cudaStream_t(stream)>>>(keys, items, sort.counts);
  check_launch("order: count");
  for (int pass = 0; pass < kPasses; ++pass) {
    pass_kernel<<<unsigned(tiles), kThreads, 0, cudaStream_t(stream)>>>(sort, pass, items, keys, order, spare_keys,
                                                                        spare_order);
    check_launch("order: pass");
    std::swap(keys, spare_keys), std::swap(order, spare_order);
  }
}

}  // namespace lfgs::cuda
