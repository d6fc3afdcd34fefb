// Stage project of a light-field frame: reads the Gaussians, writes the splats with their colours and depths and the
// frame's state. A thread has a Gaussian. The last block to end chooses the kernel that will composite the frame.
#include <algorithm>
#include <cstddef>

#include "cuda/common/launch.h"
#include "cuda/frame/direct_frame.h"
#include "cuda/frame/kernel_cost.cuh"
#include "cuda/direct/project_direct.cuh"

namespace lfgs::cuda {
namespace {

constexpr int kThreads = 128;

// The largest error of a Gaussian's colour as a parabola within a lens column. It is evaluated at the ends of the lens
// column, and midway between the points of the fit.
__device__ __noinline__ float lens_column_colour_error(const DirectFrame& frame, const Gaussians<const float> gaussians,
                                                       const Camera<double>& rig, int64_t i) {
  constexpr float kNodes[] = {-kParabolaPlace, 0, kParabolaPlace}, kBetween[] = {-1, -0.4082483f, 0.4082483f, 1};
  const CircleOfGaussian colour(gaussians, rig, i);
  const LensColumns& lens_columns = frame.optics.lens_columns;
  float worst = 0;
  for (int t = 0; t < lens_columns.count; ++t) {
    auto seen = [&](float part, int c) {
      const CirclePoint<float> point(float(colour.circle.place), float(colour.circle.distance),
                                     fmaf(part, lens_columns.half[t], lens_columns.centre[t]));
      return fmaxf(point.colour([&](int m) { return float(colour.terms[m][c]); }), 0.f);
    };
    for (int c = 0; c < 3; ++c) {
      const float low = seen(kNodes[0], c), middle = seen(kNodes[1], c), high = seen(kNodes[2], c);
      for (float part : kBetween) {
        const float parabola = middle + part * (kParabolaPlace * (high - low) + part * (high + low - 2 * middle));
        worst = fmaxf(worst, fabsf(parabola - seen(part, c)));
      }
    }
  }
  return worst;
}

// Count the splats whose colours the lens column kernel would draw too wrong. Within a lens column of half width w, the
// error is at most w^3 / 12 times the third derivative by s. By the angle, harmonic k has derivatives of at most k, k^2
// and k^3 times its amplitude. By s, the angle has 1 / r, 1 / r^2 and 2 / r^3 at a distance r from the cameras.
struct LensColumnWatch {
  const DirectFrame& frame;
  const Gaussians<const float>& gaussians;
  const Camera<double>& rig;
  int64_t i;

  __device__ void operator()(const Splat<float>& splat, const ColourCircle<float>& circle,
                             const glm::vec3& amplitudes) const {
    if (!(frame.lens_column_error > 0)) return;
    const float u = fmaxf(fabsf(circle.place) - 1, 0.f), w = frame.optics.lens_columns.widest;
    const float inverse = rsqrtf(fmaf(u, u, circle.distance * circle.distance)) * w;
    const float derivative = 6 * amplitudes.x + 24 * amplitudes.y + 60 * amplitudes.z;
    const float most = frame.lens_column_error * exp2f(-splat.log2_opacity);
    if (inverse * inverse * inverse * derivative * (1 / 12.f) <= most) return;
    if (lens_column_colour_error(frame, gaussians, rig, i) > most) atomicAdd(&frame.state->bent_colours, 1u);
  }
};

// Project a Gaussian a thread. Some blocks also add their splats to the frame's sums; the last of these to end reads
// the sums and chooses.
template <int Order, bool kCompensated>
__global__ void frame_project_kernel(Gaussians<const float> gaussians, const __grid_constant__ DirectFrame frame,
                                     const __grid_constant__ RoundedRig rig, const __grid_constant__ BasisTable basis) {
  const int64_t i = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  Splat<float> splat;
  splat.reach_y = -1;
  if (i < gaussians.count) {
    const LensColumnWatch watch{frame, gaussians, rig.exact, i};
    splat = store_splat<Order, kCompensated>(
        gaussians, rig, frame.optics.width_px, frame.optics.height_px, basis, {frame.colour_error, frame.left_out},
        frame.cut, frame.in_half, frame.least_light, i, frame.splats, frame.depths, &frame.state->colour_error, watch);
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

// Has the frame drawn by pixels if a colour was found that the lens column kernel would draw too wrong. After project:
// blocks may find one when the kernel has been chosen already.
__global__ void settle_kernel(FrameState* state) {
  if (state->bent_colours) state->choice = state->by_pixels;
}

}  // namespace

void frame_project(const DirectFrame& frame, const Gaussians<const float>& gaussians, bool keep_lists, Stream stream) {
  require(gaussians.count == frame.splats.count && gaussians.sh_degree == frame.sh_degree,
          "a frame for " + std::to_string(frame.splats.count) + " Gaussians of degree " +
              std::to_string(frame.sh_degree) + " got " + std::to_string(gaussians.count) + " of degree " +
              std::to_string(gaussians.sh_degree));

  // Clear the state, and with it the ranges; if the lists are kept, only what project and composite count
  const size_t first = keep_lists ? offsetof(FrameState, colour_error) : 0;
  const size_t end = keep_lists ? sizeof(FrameState) : frame.cleared_bytes;
  check(cudaMemsetAsync(reinterpret_cast<char*>(frame.state) + first, 0, end - first, cudaStream_t(stream)),
        "project: clear the state");

  // Where lists are kept, the kernel must be the one for which they were made
  const bool settles = frame.splats.colour_order > 2 && frame.has_lens_column() && frame.forced < 0;
  DirectFrame own = frame;
  if (keep_lists || !settles) own.lens_column_error = 0;

  const BasisTable basis{ColourBasis(frame.splats.colour_order)};
  const int64_t blocks = std::max<int64_t>(blocks_for(gaussians.count, kThreads), 1);  // without Gaussians, one chooses
  with_order(frame.splats.colour_order, frame.rig.compensated(), [&](auto order, auto compensated) {
    frame_project_kernel<order, compensated>
        <<<unsigned(blocks), kThreads, 0, cudaStream_t(stream)>>>(gaussians, own, RoundedRig(frame.rig), basis);
  });
  check_launch("frame_project");
  if (!settles) return;
  settle_kernel<<<1, 1, 0, cudaStream_t(stream)>>>(frame.state);
  check_launch("frame_project: settle");
}

}  // namespace lfgs::cuda
