// Stage project of a light-field frame: reads the Gaussians, writes the splats with their colours and depths and the
// frame's state. A thread has a Gaussian. The last block to end chooses the kernel that will composite the frame.
#include <algorithm>
#include <cstddef>

#include "cuda/common/check.h"
#include "cuda/frame/lens_frame.h"
#include "cuda/frame/lens_plan.cuh"
#include "cuda/lens/project_lens.cuh"

namespace lfgs::cuda {
namespace {

constexpr int kThreads = 128;

// Projects a Gaussian a thread. Some blocks also add their splats to the frame's sums; the last of these to end reads
// the sums and chooses.
template <int Order, bool kCompensated>
__global__ void frame_project_kernel(Gaussians<const float> gaussians, const __grid_constant__ LensFrame frame,
                                     const __grid_constant__ Rig rig, const __grid_constant__ BasisTable basis) {
  const int64_t i = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  Splat<float> splat;
  splat.reach_y = -1;
  if (i < gaussians.count) {
    splat = store_splat<Order, kCompensated>(gaussians, rig, frame.optics.width_px, frame.optics.height_px, basis,
                                             frame.tolerance, frame.cut, frame.in_half, frame.least_light, i,
                                             frame.splats, frame.depths, &frame.state->colour_error);
    if (splat.reach_y == kPruned) atomicAdd(&frame.state->pruned, 1u);
  }
  const unsigned stride = sample_stride(gaussians.count);
  if (blockIdx.x % stride) return;
  add_to_sums(frame, splat);
  __threadfence();
  __syncthreads();
  if (threadIdx.x == 0 && atomicAdd(&frame.state->blocks_summed, 1u) == (gridDim.x - 1) / stride) {
    __threadfence();
    choose_kernel<kCompensated>(frame);
  }
}

}  // namespace

void frame_project(const LensFrame& frame, const Gaussians<const float>& gaussians, bool keep_lists, Stream stream) {
  require(gaussians.count == frame.splats.count && gaussians.sh_degree == frame.sh_degree,
          "a frame for " + std::to_string(frame.splats.count) + " Gaussians of degree " +
              std::to_string(frame.sh_degree) + " got " + std::to_string(gaussians.count) + " of degree " +
              std::to_string(gaussians.sh_degree));

  // Clear the state, and with it the ranges; if the lists are kept, only what project and composite count
  const size_t first = keep_lists ? offsetof(FrameState, colour_error) : 0;
  const size_t end = keep_lists ? sizeof(FrameState) : frame.cleared_bytes;
  check(cudaMemsetAsync(reinterpret_cast<char*>(frame.state) + first, 0, end - first, cudaStream_t(stream)),
        "project: clear the state");

  const BasisTable basis{ColourBasis(frame.splats.colour_order)};
  const int64_t blocks = std::max<int64_t>(blocks_for(gaussians.count, kThreads), 1);  // without Gaussians, one chooses
  with_order(frame.splats.colour_order, frame.rig.compensated(), [&](auto order, auto compensated) {
    frame_project_kernel<order, compensated>
        <<<unsigned(blocks), kThreads, 0, cudaStream_t(stream)>>>(gaussians, frame, Rig(frame.rig), basis);
  });
  check_launch("frame_project");
}

}  // namespace lfgs::cuda
