// Stages bin and order of a light-field frame. Stage bin lists, for every tile (and group of lens columns), the splats
// that may touch it, in no order yet. It reads the projected splats and writes DirectFrame::ranges and ids. There are
// three steps: count the intersections (tile, splat) of every list, give every list its place, and visit the
// intersections again to fill it. Stage order reads the depths, and sorts every list in place. Whether the tiles are of
// pixels or of lenses was decided on the device, by the kernel that the frame chose.
#include <algorithm>

#include "cuda/common/blend.cuh"
#include "cuda/common/launch.h"
#include "cuda/common/gaussian_io.cuh"
#include "cuda/common/splat_lists.cuh"
#include "cuda/frame/direct_frame.h"
#include "cuda/frame/lens_optics.cuh"
#include "cuda/frame/strip.cuh"

namespace lfgs::cuda {
namespace {

constexpr int kThreads = 256, kMostLanes = 8;
constexpr int64_t kCrowd = 1 << 18;  // so many threads fill the device

// How many lanes share a splat. With tiles of lenses there is more to share: every group of lens columns has its own
// run of tiles. A small splat in tiles of pixels has only one or two runs. Where splats are few, more lanes share each,
// so that the device is busy.
__device__ int lanes_per_splat(const DirectFrame& frame) {
  int lanes = frame.lens_column_chosen() ? 4 : 1;
  while (lanes < kMostLanes && frame.splats.count * lanes < kCrowd) lanes *= 2;
  return lanes;
}

// Call visit(first, last) for the runs of tiles that a splat may touch. In every row of tiles there is a run for each
// group of lens columns; this lane takes every `lanes`-th run, from number `lane` on. It passes numbers of
// lists, and lists of neighbouring tiles in the run are `groups` numbers apart.
template <class Visit>
__device__ void for_each_run(const Splat<float>& s, const DirectFrame& frame, int lane, int lanes, const Visit& visit) {
  const bool by_lens = frame.lens_column_chosen();
  const Tiling& tiling = frame.tiling();
  const float height = float(tiling.height);
  const int first = max(0, int(floorf((s.v0 - s.reach_y + 0.5f) / height)));
  const int last = min(tiling.down - 1, int(floorf((s.v0 + s.reach_y - 0.5f) / height)));
  const int groups = tiling.groups, runs = (last - first + 1) * groups;
  for (int k = lane; k < runs; k += lanes) {
    const int row = first + k / groups, group = k % groups;
    float centre = 0, half = 1;
    if (by_lens) group_offsets(frame.optics.lens_columns, group, centre, half);

    // The area of the splat in these rows, seen from the group's offsets, and its tiles
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

// The two passes over the intersections. kCount counts them, in the place of the ends of the lists. kFill fills the
// lists; if the frame has more intersections than places it fills one list of all splats drawn instead.
enum class Pass { kCount, kFill };

// The lanes that have an intersection of the same list at the same time. Successive splats often lie side by side, as
// in the sheet of a photo, and bin waits for additions to the ends of lists. So these lanes combine their additions.
struct Together {
  unsigned lanes, before;  // a bit each; before: the lanes before this one
  int first;

  __device__ explicit Together(int list) {
    lanes = __match_any_sync(__activemask(), list);
    before = lanes & ((1u << threadIdx.x % 32) - 1);
    first = __ffs(int(lanes)) - 1;
  }
  __device__ unsigned count() const { return unsigned(__popc(lanes)); }
  // Make a list longer by an intersection of each lane.
  __device__ void lengthen(unsigned& end) const {
    if (!before) atomicAdd(&end, count());
  }
  // The same; return this lane's place.
  __device__ unsigned place(unsigned& end) const {
    unsigned begin = 0;
    if (!before) begin = atomicAdd(&end, count());
    return __shfl_sync(lanes, begin, first) + unsigned(__popc(before));
  }
};

// Go through the intersections. Some lanes of a warp share a splat, see lanes_per_splat(). A block takes as many splats
// at a time as it has threads for. One kernel does both passes, so that they find the same tiles to the last bit.
__global__ void __launch_bounds__(kThreads) intersections_kernel(const __grid_constant__ DirectFrame frame, Pass pass) {
  uint2* ranges = reinterpret_cast<uint2*>(frame.ranges);
  const int lanes = lanes_per_splat(frame), lane = int(threadIdx.x) % lanes, groups = frame.tiling().groups;
  const bool fill = pass == Pass::kFill, overfull = fill && frame.overfull();
  const int64_t step = int64_t(gridDim.x) * kThreads / lanes;
  unsigned drawn = 0;
  for (int64_t id = (int64_t(blockIdx.x) * kThreads + threadIdx.x) / lanes; id < frame.splats.count; id += step) {
    const Splat<float> splat = read_splat(frame.splats.splats + id);
    if (!(splat.reach_y >= 0)) continue;
    drawn += lane == 0;
    if (overfull) {
      if (lane == 0) frame.ids[atomicAdd(&frame.state->next_splat, 1u)] = uint32_t(id);
      continue;
    }
    for_each_run(splat, frame, lane, lanes, [&](int first, int last) {
      for (int tile = first; tile <= last; tile += groups) {
        const Together together(tile);
        if (fill)
          frame.ids[together.place(ranges[tile].y)] = uint32_t(id);
        else
          together.lengthen(ranges[tile].y);
      }
    });
  }
  const unsigned of_warp = fill ? 0 : sum_to_lane(drawn);
  if (threadIdx.x % 32 == 31 && of_warp) atomicAdd(&frame.state->drawn, of_warp);
}

// A thread has a list.
__global__ void __launch_bounds__(kThreads) place_lists_kernel(const __grid_constant__ DirectFrame frame) {
  FrameState& state = *frame.state;
  place_lists(frame.tiling().tiles(), reinterpret_cast<uint2*>(frame.ranges), state.intersections, state.long_lists,
              frame.long_lists);
}

// Where the frame has more intersections than its capacity there is one list, of all splats drawn. The first block
// sorts it.
__global__ void __launch_bounds__(sorting::kThreads, 4) sort_lists_kernel(const __grid_constant__ DirectFrame frame) {
  __shared__ uint64_t keys[sorting::kKept];
  __shared__ unsigned buckets[sorting::kKept], warps[2 * sorting::kWarps];
  const FrameState& state = *frame.state;
  if (frame.overfull()) {
    if (blockIdx.x == 0) sorting::sort_in_pieces(frame.ids, state.drawn, sorting::Keys{frame.depths}, keys);
    return;
  }
  const uint2* ranges = reinterpret_cast<const uint2*>(frame.ranges);
  sorting::sort_lists({frame.tiling().tiles(), ranges, frame.ids, frame.depths, frame.long_lists, state.long_lists},
                      {keys, buckets, warps});
}

}  // namespace

void frame_bin(const DirectFrame& frame, Stream stream) {
  const int64_t count = frame.splats.count;
  if (count == 0) return;
  const int64_t most = blocks_for(count * kMostLanes, kThreads);
  const unsigned blocks = unsigned(std::min<int64_t>(resident_blocks(intersections_kernel, kThreads, 0), most));
  intersections_kernel<<<blocks, kThreads, 0, cudaStream_t(stream)>>>(frame, Pass::kCount);
  check_launch("bin: count");
  const unsigned list_blocks = unsigned(blocks_for(frame.most_lists(), kThreads));
  place_lists_kernel<<<list_blocks, kThreads, 0, cudaStream_t(stream)>>>(frame);
  check_launch("bin: place");
  intersections_kernel<<<blocks, kThreads, 0, cudaStream_t(stream)>>>(frame, Pass::kFill);
  check_launch("bin: fill");
}

void frame_order(const DirectFrame& frame, Stream stream) {
  if (frame.splats.count == 0) return;
  const int64_t most = blocks_for(frame.most_lists(), sorting::kWarps);
  const unsigned blocks = unsigned(std::min<int64_t>(resident_blocks(sort_lists_kernel, sorting::kThreads, 0), most));
  sort_lists_kernel<<<blocks, sorting::kThreads, 0, cudaStream_t(stream)>>>(frame);
  check_launch("order");
}

}  // namespace lfgs::cuda
