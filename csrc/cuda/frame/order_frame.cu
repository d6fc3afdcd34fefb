// Stage order of a light-field frame: sorts every list that bin has filled by depth. It reads the depths, and sorts
// DirectFrame::ids in place.
#include <algorithm>

#include "cuda/common/check.h"
#include "cuda/common/sort_lists.cuh"
#include "cuda/frame/direct_frame.h"

namespace lfgs::cuda {
namespace {

// Where the frame has more intersections than places there is but one list, of all splats drawn, and the first block
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

void frame_order(const DirectFrame& frame, Stream stream) {
  if (frame.splats.count == 0) return;
  const int64_t most = blocks_for(frame.most_lists(), sorting::kWarps);
  const unsigned blocks = unsigned(std::min<int64_t>(resident_blocks(sort_lists_kernel, sorting::kThreads, 0), most));
  sort_lists_kernel<<<blocks, sorting::kThreads, 0, cudaStream_t(stream)>>>(frame);
  check_launch("order");
}

}  // namespace lfgs::cuda
