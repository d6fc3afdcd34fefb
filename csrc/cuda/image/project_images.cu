// Stage project for ordinary images on the device: reads Gaussians and cameras, writes splats with their colours and
// the keys by which they are sorted. A thread has a Gaussian in one image. Arithmetic is in float, but in double for
// compensated splats, for cameras that are no pinholes, and for rolling shutters.
#include "cuda/common/launch.h"
#include "cuda/common/gaussian_io.cuh"
#include "cuda/stages/projection.cuh"
#include "cuda/stages/stages.h"
#include "math/footprint.h"
#include "math/harmonics.h"

namespace lfgs::cuda {
namespace {

using glm::vec3;
constexpr int kThreads = 128;

// Cull and store one splat and its sort key; return whether it is drawn.
__device__ bool store_splat(Splat<float> splat, const Cameras<float>& cameras, int64_t image, int64_t index,
                            const Splats<float>& out, uint64_t* keys) {
  cull_outside(splat, cameras.width_px, cameras.height_px);
  write_splat(splat, out.splats + index);
  const bool drawn = splat.reach_y >= 0;
  keys[index] = drawn ? uint64_t(image) << kDepthBits | __float_as_uint(splat.depth) : ~uint64_t(0);
  return drawn;
}

// Project all Gaussians into all images: blocks along x have the Gaussians of a scene, along y the images.
template <Way kWay>
__global__ void project_images_kernel(Gaussians<const float> gaussians, Cameras<float> cameras, Splats<float> out,
                                      uint64_t* keys) {
  const int64_t i = int64_t(blockIdx.x) * kThreads + threadIdx.x, image = blockIdx.y, n = gaussians.count;
  if (i >= n) return;
  const Gaussians<const float> scene = gaussians.slice(image / cameras.per_scene * n);
  const Camera<float> camera = cameras.camera<float>(image);
  const Shape<float> shape = load_shape<float>(scene, i);
  const int64_t index = image * n + i;
  vec3 colour(0);
  if (store_splat(projected<kWay>(cameras, image, camera, shape), cameras, image, index, out, keys))
    colour = sh_colour<float>(scene.sh_degree, scene.sh + 3 * scene.sh_count() * i, shape.mean,
                              eye_of<kWay>(cameras, image, camera, shape.mean));
  store_colour(colour, out.colours, index);
}

}  // namespace

void project_images(const Gaussians<const float>& gaussians, const Cameras<float>& cameras, const Splats<float>& out,
                    uint64_t* keys, Stream stream) {
  if (gaussians.count == 0 || cameras.images() == 0) return;
  require(cameras.images() <= kMostImages, std::to_string(cameras.images()) +
                                               " images, and at most 65,535 are drawn "
                                               "at a time on CUDA: render fewer scenes or cameras in a call");
  const dim3 blocks(unsigned(blocks_for(gaussians.count, kThreads)), unsigned(cameras.images()));
  const Way way = way_of(cameras);
  const auto kernel = way == Way::kRolling ? project_images_kernel<Way::kRolling>
                      : way == Way::kExact ? project_images_kernel<Way::kExact>
                                           : project_images_kernel<Way::kFast>;
  kernel<<<blocks, kThreads, 0, cudaStream_t(stream)>>>(gaussians, cameras, out, keys);
  check_launch("project_images");
}

}  // namespace lfgs::cuda
