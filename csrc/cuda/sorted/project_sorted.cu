// Stage project of `sorted` on the device: reads Gaussians and cameras, writes the splats of every view, their colours
// and depths. A thread has a Gaussian in one view.
#include <algorithm>

#include "cuda/common/launch.h"
#include "cuda/common/gaussian_io.cuh"
#include "cuda/sorted/footprint_io.cuh"
#include "cuda/sorted/sorted.h"
#include "cuda/stages/projection.cuh"
#include "math/footprint.h"
#include "math/harmonics.h"

namespace lfgs::cuda {
namespace {

using glm::vec3;
constexpr int kThreads = 128;

// Blocks along x have the Gaussians, along y the views.
template <bool kCompensated>
__global__ void __launch_bounds__(kThreads)
    project_sorted_kernel(Gaussians<const float> gaussians, Cameras<float> cameras, SortedChunk chunk) {
  const int64_t i = int64_t(blockIdx.x) * kThreads + threadIdx.x, image = blockIdx.y;
  if (i >= gaussians.count) return;
  const Camera<float> camera = cameras.camera<float>(image);
  const Shape<float> shape = load_shape<float>(gaussians, i);
  const int64_t index = image * gaussians.count + i;
  Splat<float> splat = projected<kCompensated ? Way::kExact : Way::kFast>(cameras, image, camera, shape);
  cull_outside(splat, cameras.width_px, cameras.height_px);
  write_footprint(splat, chunk.footprints, index);
  if (!(splat.reach_y >= 0)) return;  // nothing reads more of it
  chunk.depths[index] = __float_as_uint(splat.depth);
  const vec3 colour =
      sh_colour<float>(gaussians.sh_degree, gaussians.sh + 3 * gaussians.sh_count() * i, shape.mean, camera.centre());
  store_colour(colour, chunk.colours, index);
}

}  // namespace

SortedChunk::SortedChunk(int64_t views, int64_t count_, int64_t width_px, int64_t height_px, const SubpixelTile& tile_)
    : image{views, width_px, height_px, {tile_.width_px, tile_.height_px()}}, count(count_), tile(tile_) {
  require(views <= kMostImages, std::to_string(views) + " views, and at most 65,535 are drawn at a time");
  require(std::max(splats(), lists()) < int64_t(1) << 31,
          "2^31 or more splats or tiles in all views: draw fewer views at a time");
}

size_t SortedChunk::place(void* work) {
  Parts parts{static_cast<char*>(work)};
  parts.take(state, 1), parts.take(ranges, 2 * lists());
  cleared_bytes = parts.used;
  parts.take(footprints, kFootprintNumbers * splats()), parts.take(colours, kColourStride * splats());
  parts.take(depths, splats()), parts.take(long_lists, lists());
  return parts.used;
}

void project_sorted(const SortedChunk& chunk, const Gaussians<const float>& gaussians, const Cameras<float>& cameras,
                    Stream stream) {
  if (chunk.splats() == 0) return;
  const dim3 blocks(unsigned(blocks_for(gaussians.count, kThreads)), unsigned(chunk.image.count));
  const auto kernel = cameras.compensated() ? project_sorted_kernel<true> : project_sorted_kernel<false>;
  kernel<<<blocks, kThreads, 0, cudaStream_t(stream)>>>(gaussians, cameras, chunk);
  check_launch("project_sorted");
}

}  // namespace lfgs::cuda
