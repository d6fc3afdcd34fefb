// Stages order and bin of a light-field frame. A splat's pairs (tile, splat) are written in depth order and sorted by
// tile, stably. Which tiles those are, of pixels or of lenses, the frame has decided on the device.
#include "cuda/lens_lists.h"

#include <cub/device/device_radix_sort.cuh>
#include <cub/device/device_scan.cuh>

#include <algorithm>
#include <bit>

#include "cuda/check.h"
#include "cuda/gaussian_io.cuh"
#include "cuda/lens_optics.cuh"
#include "cuda/strip.cuh"

namespace lfgs::cuda {
namespace {

constexpr int kThreads = 128, kMostLanes = 4;
constexpr int64_t kCrowd = 1 << 18;  // splats that fill the device with a lane each

__device__ bool ordinal_chosen(const LensFrame& frame) {
  return frame.state->kernel == int(LensKernel::kOrdinal);
}

// How many lanes share a splat: groups of ordinals give it more runs of tiles, small splats have one or two.
__device__ int lanes_of(const LensFrame& frame) {
  return ordinal_chosen(frame) ? kMostLanes : frame.splats.count < kCrowd ? 2 : 1;
}

// Calls visit(first, last, stride) for the runs of tiles, tile row by tile row and group by group, that a splat may
// touch: for every `lanes`-th of them from number `lane`.
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
    if (b >= a) visit((row * tiling.across + a) * groups + group, (row * tiling.across + b) * groups + group, groups);
  }
}

// Also empties the ranges.
__global__ void count_kernel(const __grid_constant__ LensFrame frame, int64_t ranges) {
  const int lanes = lanes_of(frame);
  const int64_t thread = int64_t(blockIdx.x) * kThreads + threadIdx.x, i = thread / lanes;
  for (int64_t at = thread; at < ranges; at += int64_t(gridDim.x) * kThreads) frame.ranges[at] = 0;
  const bool inside = i < frame.splats.count;
  int64_t count = 0;
  if (inside && frame.sorted_depths[i] != kNotDrawn)
    for_each_run(read_splat(frame.splats.splats + frame.order[i]), frame, threadIdx.x % lanes, lanes,
                 [&](int first, int last, int stride) { count += (last - first) / stride + 1; });
  for (int step = 1; step < lanes; step *= 2) count += __shfl_xor_sync(~0u, count, step);
  if (inside && threadIdx.x % lanes == 0) frame.ends[i] = count;
}

// Where the frame has more pairs than places none is written: composite then walks all splats. Places that stay empty
// hold the largest key, beyond every tile.
template <class Key>
__global__ void fill_kernel(const __grid_constant__ LensFrame frame) {
  const int lanes = lanes_of(frame), lane = threadIdx.x % lanes;
  const int64_t thread = int64_t(blockIdx.x) * kThreads + threadIdx.x, i = thread / lanes, n = frame.splats.count;
  const int64_t pairs = frame.ends[n - 1], used = pairs <= frame.capacity ? pairs : 0;
  const bool inside = i < n && frame.sorted_depths[i] != kNotDrawn;
  if (thread == 0) frame.state->pairs = pairs;
  if (inside && lane == 0 && (i == n - 1 || frame.sorted_depths[i + 1] == kNotDrawn))
    frame.state->drawn = unsigned(i + 1);
  Key* keys = static_cast<Key*>(frame.keys);
  for (int64_t at = used + thread; at < frame.capacity; at += int64_t(gridDim.x) * kThreads)
    keys[at] = Key(~Key(0)), frame.values[at] = 0;
  if (pairs > frame.capacity) return;
  const uint32_t id = inside ? frame.order[i] : 0;
  Splat<float> splat;
  splat.reach_y = -1;
  if (inside) splat = read_splat(frame.splats.splats + id);

  // Places of this lane's pairs: after those of the lanes before it
  int64_t mine = 0;
  if (lanes > 1)
    for_each_run(splat, frame, lane, lanes,
                 [&](int first, int last, int stride) { mine += (last - first) / stride + 1; });
  int64_t sum = mine;
  for (int step = 1; step < lanes; step *= 2) {
    const int64_t other = __shfl_up_sync(~0u, sum, step, lanes);
    if (lane >= step) sum += other;
  }
  int64_t at = (inside && i ? frame.ends[i - 1] : 0) + sum - mine;
  for_each_run(splat, frame, lane, lanes, [&](int first, int last, int stride) {
    for (int tile = first; tile <= last; tile += stride, ++at) keys[at] = Key(tile), frame.values[at] = id;
  });
}

template <class Key>
__global__ void ranges_kernel(const __grid_constant__ LensFrame frame) {
  const int64_t i = int64_t(blockIdx.x) * kThreads + threadIdx.x, pairs = int64_t(frame.state->pairs);
  if (i >= pairs || pairs > frame.capacity) return;
  const Key* keys = static_cast<const Key*>(frame.sorted_keys);
  const Key tile = keys[i];
  if (i == 0 || keys[i - 1] != tile) frame.ranges[2 * int64_t(tile)] = uint32_t(i);
  if (i == pairs - 1 || keys[i + 1] != tile) frame.ranges[2 * int64_t(tile) + 1] = uint32_t(i + 1);
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
void fill(const LensFrame& frame, cudaStream_t stream) {
  const int64_t n = frame.splats.count, capacity = frame.capacity;
  fill_kernel<Key><<<unsigned(blocks_for(n * kMostLanes, kThreads)), kThreads, 0, stream>>>(frame);
  check_launch("bin: fill");
  if (capacity == 0) return;
  size_t bytes = frame.temporary_bytes;
  const int bits = std::bit_width(uint64_t(frame.most_tiles()));
  check(cub::DeviceRadixSort::SortPairs(frame.temporary, bytes, static_cast<Key*>(frame.keys),
                                        static_cast<Key*>(frame.sorted_keys), frame.values, frame.sorted_values,
                                        capacity, 0, bits, stream),
        "bin: sort");
  ranges_kernel<Key><<<unsigned(blocks_for(capacity, kThreads)), kThreads, 0, stream>>>(frame);
  check_launch("bin: ranges");
}

}  // namespace

size_t lists_temporary_bytes(const LensFrame& frame) {
  size_t scan = 0;
  check(cub::DeviceScan::InclusiveSum(nullptr, scan, (int64_t*)nullptr, (int64_t*)nullptr, frame.splats.count),
        "lists: size of the scan");
  const int64_t capacity = frame.capacity;
  const size_t pairs = frame.key_bytes == 2 ? sort_bytes<uint16_t>(capacity) : sort_bytes<uint32_t>(capacity);
  return std::max({scan, sort_bytes<uint32_t>(frame.splats.count), pairs});
}

void frame_order(const LensFrame& frame, Stream stream) {
  if (frame.splats.count == 0) return;
  size_t bytes = frame.temporary_bytes;
  // What is not drawn has the largest key and comes last
  check(cub::DeviceRadixSort::SortPairs(frame.temporary, bytes, frame.depths, frame.sorted_depths, frame.indices,
                                        frame.order, frame.splats.count, 0, 32, cudaStream_t(stream)),
        "order");
}

void frame_count(const LensFrame& frame, Stream stream) {
  const int64_t n = frame.splats.count;
  const int64_t ranges = 2 * frame.most_tiles();
  const int64_t blocks = blocks_for(std::max<int64_t>(n, 1) * kMostLanes, kThreads);
  count_kernel<<<unsigned(blocks), kThreads, 0, cudaStream_t(stream)>>>(frame, ranges);
  check_launch("bin: count");
  size_t bytes = frame.temporary_bytes;
  if (n > 0)
    check(cub::DeviceScan::InclusiveSum(frame.temporary, bytes, frame.ends, frame.ends, n, cudaStream_t(stream)),
          "bin: scan");
}

void frame_fill(const LensFrame& frame, Stream stream) {
  if (frame.splats.count == 0) return;
  if (frame.key_bytes == 2)
    fill<uint16_t>(frame, cudaStream_t(stream));
  else
    fill<uint32_t>(frame, cudaStream_t(stream));
}

}  // namespace lfgs::cuda
