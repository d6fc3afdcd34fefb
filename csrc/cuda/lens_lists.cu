// Stages order and bin of a light-field frame. A splat's pairs (tile, splat) are written in depth order and sorted by
// tile, stably. Which tiles those are, of pixels or of lenses, the frame has decided on the device.
#include "cuda/lens_lists.h"

#include <cub/device/device_radix_sort.cuh>

#include <algorithm>
#include <bit>

#include "cuda/check.h"
#include "cuda/gaussian_io.cuh"
#include "cuda/lens_optics.cuh"
#include "cuda/look_back.cuh"
#include "cuda/strip.cuh"

namespace lfgs::cuda {
namespace {

constexpr int kThreads = 256, kWarps = kThreads / 32, kMostLanes = 4;
constexpr int kKeptRuns = 4, kKeysEach = 8;
constexpr int64_t kCrowd = 1 << 18;  // splats that fill the device with a lane each

__device__ bool ordinal_chosen(const LensFrame& frame) {
  return frame.state->kernel == int(LensKernel::kOrdinal);
}

// How many lanes share a splat: groups of ordinals give it more runs of tiles, small splats have one or two.
__device__ int lanes_of(const LensFrame& frame) {
  return ordinal_chosen(frame) ? kMostLanes : frame.splats.count < kCrowd ? 2 : 1;
}

// Calls visit(first, last) for the runs of tiles, tile row by tile row and group by group, that a splat may touch: for
// every `lanes`-th of them from number `lane`. Tiles of a run are as far apart as there are groups.
template <class Visit>
__device__ void for_each_run(const Splat<float>& s, const LensFrame& frame, int lane, int lanes, const Visit& visit) {
  if (!(s.reach_y >= 0)) return;
  const bool by_lens = ordinal_chosen(frame);
  const Tiling& tiling = by_lens ? frame.ordinal : frame.pixel;
  const float height = float(tiling.height);
  const int first = max(0, int(floorf((s.v0 - s.reach_y + 0.5f) / height)));
  const int last = min(tiling.down - 1, int(floorf((s.v0 + s.reach_y - 0.5f) / height)));
  const int groups = tiling.groups, runs = (last - first + 1) * groups;
  for (int k = lane; k < runs; k += lanes) {
    const int row = first + k / groups, group = k % groups;
    float centre = 0, half = 1;
    if (by_lens) group_offsets(frame.optics.ordinals, group, centre, half);
    const float top = float(row) * height;
    const Strip strip(s, top + 0.5f, top + height - 0.5f, tiling.shear);
    if (strip.range < 0) continue;
    const Span span = strip.at(s, centre, half);
    const float reach = span.spread + sqrtf(span.square);
    const float low = fmaf(tiling.scale, span.middle - reach, tiling.low) / tiling.width;
    const float high = fmaf(tiling.scale, span.middle + reach, tiling.high) / tiling.width;
    const int a = int(fmaxf(floorf(low), 0.f)), b = int(fminf(floorf(high), float(tiling.across - 1)));
    if (b >= a) visit((row * tiling.across + a) * groups + group, (row * tiling.across + b) * groups + group);
  }
}

// Where the pairs of this thread begin, in the order of pieces and threads. By all threads of a block.
__device__ int64_t place_of_pairs(const LensFrame& frame, int64_t piece, int64_t pieces, int64_t count) {
  __shared__ int64_t warps[kWarps];
  const int warp = threadIdx.x / 32, lane = threadIdx.x % 32;
  const int64_t sum = sum_to_lane(count);
  if (lane == 31) warps[warp] = sum;
  __syncthreads();
  if (warp == 0) {
    const int64_t of_warp = lane < kWarps ? warps[lane] : 0, to_warp = sum_to_lane(of_warp);
    const int64_t all = __shfl_sync(~0u, to_warp, 31);
    volatile uint64_t* words = frame.prefixes;
    if (lane == 0) words[piece] = flagged(all, kOfPiece);
    const int64_t before = sum_before(words, piece);
    if (lane == 0) words[piece] = flagged(before + all, kOfAll);
    if (lane == 0 && piece == pieces - 1) frame.state->pairs = before + all;
    if (lane < kWarps) warps[lane] = before + to_warp - of_warp;
  }
  __syncthreads();
  return warps[warp] + sum - count;
}

// Writes the pairs in depth order, in one pass: a block takes a piece of the splats, counts its pairs, learns from the
// pieces before where they begin. Places that stay empty hold the largest key, beyond every tile. Where the frame has
// more pairs than places, composite walks all splats and needs none of this. 256 threads: blocks of more wait longer
// for their slowest splat, pieces of fewer have more words to look back through.
template <class Key>
__global__ void __launch_bounds__(kThreads) pairs_kernel(const __grid_constant__ LensFrame frame) {
  __shared__ unsigned next;
  __shared__ int64_t pairs;
  __shared__ int2 kept[kKeptRuns][kThreads];  // so that few look for their runs again to write them
  FrameState& state = *frame.state;
  const int lanes = lanes_of(frame), lane = threadIdx.x % lanes;
  const int64_t n = frame.splats.count, pieces = blocks_for(n * lanes, kThreads);
  const int stride = ordinal_chosen(frame) ? frame.ordinal.groups : frame.pixel.groups;
  Key* keys = static_cast<Key*>(frame.keys);
  for (;;) {
    if (threadIdx.x == 0) next = atomicAdd(&state.next_piece, 1u);
    __syncthreads();
    const int64_t piece = next;
    if (piece >= pieces) break;
    const int64_t i = (piece * kThreads + threadIdx.x) / lanes;
    const bool inside = i < n && frame.sorted_depths[i] != kNotDrawn;
    if (inside && lane == 0 && (i == n - 1 || frame.sorted_depths[i + 1] == kNotDrawn)) state.drawn = unsigned(i + 1);
    const uint32_t id = inside ? frame.order[i] : 0;
    int runs = 0;
    int64_t count = 0;
    if (inside)
      for_each_run(read_splat(frame.splats.splats + id), frame, lane, lanes, [&](int first, int last) {
        if (runs < kKeptRuns) kept[runs][threadIdx.x] = make_int2(first, last);
        ++runs, count += (last - first) / stride + 1;
      });
    int64_t at = place_of_pairs(frame, piece, pieces, count);
    auto write = [&](int first, int last) {
      for (int tile = first; tile <= last && at < frame.capacity; tile += stride, ++at)
        keys[at] = Key(tile), frame.values[at] = id;
    };
    if (runs <= kKeptRuns)
      for (int k = 0; k < runs; ++k) write(kept[k][threadIdx.x].x, kept[k][threadIdx.x].y);
    else
      for_each_run(read_splat(frame.splats.splats + id), frame, lane, lanes, write);
  }
  if (threadIdx.x < 32) {
    const int64_t all = sum_before(frame.prefixes, pieces);
    if (threadIdx.x == 0) pairs = all;
  }
  __syncthreads();
  const int64_t step = int64_t(gridDim.x) * kThreads;
  for (int64_t at = pairs + int64_t(blockIdx.x) * kThreads + threadIdx.x; at < frame.capacity; at += step)
    keys[at] = Key(~Key(0)), frame.values[at] = 0;
}

template <class Key>
__global__ void ranges_kernel(const __grid_constant__ LensFrame frame) {
  const int64_t pairs = int64_t(frame.state->pairs), i = (int64_t(blockIdx.x) * kThreads + threadIdx.x) * kKeysEach;
  if (i >= pairs || pairs > frame.capacity) return;
  const Key* keys = static_cast<const Key*>(frame.sorted_keys);
  uint2* ranges = reinterpret_cast<uint2*>(frame.ranges);
  Key before = i ? keys[i - 1] : Key(~Key(0));
#pragma unroll
  for (int k = 0; k < kKeysEach; ++k) {
    if (i + k >= pairs) break;
    const Key tile = keys[i + k];
    if (tile != before) {
      ranges[tile].x = uint32_t(i + k);
      if (i + k) ranges[before].y = uint32_t(i + k);
    }
    before = tile;
  }
  if (i + kKeysEach >= pairs) ranges[before].y = uint32_t(pairs);
}

template <class Key>
size_t sort_bytes(int64_t items) {
  size_t bytes = 0;
  check(cub::DeviceRadixSort::SortPairs(nullptr, bytes, (Key*)nullptr, (Key*)nullptr, (uint32_t*)nullptr,
                                        (uint32_t*)nullptr, items),
        "lists: size of a sort");
  return bytes;
}

template <class Key>
void bin(const LensFrame& frame, cudaStream_t stream) {
  const int64_t capacity = frame.capacity;
  auto* kernel = pairs_kernel<Key>;
  const int64_t blocks = std::min<int64_t>(resident_blocks(kernel, kThreads, 0), most_pieces(frame));
  kernel<<<unsigned(blocks), kThreads, 0, stream>>>(frame);
  check_launch("bin: pairs");
  if (capacity == 0) return;
  size_t bytes = frame.temporary_bytes;
  const int bits = std::bit_width(uint64_t(frame.most_tiles()));
  check(cub::DeviceRadixSort::SortPairs(frame.temporary, bytes, static_cast<Key*>(frame.keys),
                                        static_cast<Key*>(frame.sorted_keys), frame.values, frame.sorted_values,
                                        capacity, 0, bits, stream),
        "bin: sort");
  ranges_kernel<Key><<<unsigned(blocks_for(capacity, kThreads * kKeysEach)), kThreads, 0, stream>>>(frame);
  check_launch("bin: ranges");
}

}  // namespace

int64_t most_pieces(const LensFrame& frame) { return blocks_for(frame.splats.count * kMostLanes, kThreads); }

size_t lists_temporary_bytes(const LensFrame& frame) {
  const int64_t capacity = frame.capacity;
  const size_t pairs = frame.key_bytes == 2 ? sort_bytes<uint16_t>(capacity) : sort_bytes<uint32_t>(capacity);
  return std::max(sort_bytes<uint32_t>(frame.splats.count), pairs);
}

void frame_order(const LensFrame& frame, Stream stream) {
  if (frame.splats.count == 0) return;
  size_t bytes = frame.temporary_bytes;
  // What is not drawn has the largest key and comes last
  check(cub::DeviceRadixSort::SortPairs(frame.temporary, bytes, frame.depths, frame.sorted_depths, frame.indices,
                                        frame.order, frame.splats.count, 0, 32, cudaStream_t(stream)),
        "order");
}

void frame_bin(const LensFrame& frame, Stream stream) {
  if (frame.splats.count == 0) return;
  if (frame.key_bytes == 2)
    bin<uint16_t>(frame, cudaStream_t(stream));
  else
    bin<uint32_t>(frame, cudaStream_t(stream));
}

}  // namespace lfgs::cuda
