// Stage project on the device: a thread per (image, Gaussian). Arithmetic is float.
#include "cuda/check.h"
#include "cuda/gaussian_io.cuh"
#include "cuda/lens_rig.cuh"
#include "cuda/stages.h"
#include "math/footprint.h"
#include "math/harmonics.h"

namespace lfgs::cuda {
namespace {

using glm::vec3;
constexpr int kThreads = 128;

// Projects, culls and stores one splat and its sort key; returns whether it is drawn.
__device__ bool store_splat(const View<float>& view, const Shape<float>& shape, int64_t width_px, int64_t height_px,
                            int64_t image, int64_t index, const Splats<float>& out, uint64_t* keys) {
  Splat<float> splat = Projection<float>(view, shape).splat(view, shape.opacity);
  cull_outside(splat, width_px, height_px);
  out.splats[index] = splat;
  const bool drawn = splat.reach_y >= 0;
  keys[index] = drawn ? uint64_t(image) << 32 | __float_as_uint(splat.depth) : ~uint64_t(0);
  return drawn;
}

__global__ void project_dense_kernel(Gaussians<const float> gaussians, Cameras<float> cameras, Splats<float> out,
                                     uint64_t* keys) {
  const int64_t i = int64_t(blockIdx.x) * kThreads + threadIdx.x, image = blockIdx.y, n = gaussians.count;
  if (i >= n) return;
  const Gaussians<const float> scene = gaussians.slice(image / cameras.per_scene * n);
  const View<float> view = cameras.view<float>(image);
  const Shape<float> shape = shape_of(scene, i);
  const int64_t index = image * n + i;
  if (!store_splat(view, shape, cameras.width_px, cameras.height_px, image, index, out, keys)) return;
  const vec3 colour =
      sh_colour<float>(scene.sh_degree, scene.sh + 3 * scene.sh_count() * i, shape.mean, view.centre());
  reinterpret_cast<float4*>(out.colours)[index] =
      make_float4(fmaxf(colour.x, 0), fmaxf(colour.y, 0), fmaxf(colour.z, 0), 0);
}

__global__ void project_lens_kernel(Gaussians<const float> gaussians, View<float> rig, int64_t width_px,
                                    int64_t height_px, BasisTable basis, float tolerance, Splats<float> out,
                                    uint64_t* keys, float* error) {
  const int64_t i = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (i >= gaussians.count) return;
  const Shape<float> shape = shape_of(gaussians, i);
  out.orders[i] = 0;
  if (!store_splat(rig, shape, width_px, height_px, 0, i, out, keys)) return;

  // Values at the nodes -> Chebyshev coefficients
  const int order = basis.order, nodes = order + 1;
  const float* sh = gaussians.sh + 3 * gaussians.sh_count() * i;
  vec3 chebyshev[kMaxColourOrder + 1];
  for (int k = 0; k < nodes; ++k) chebyshev[k] = vec3(0);
  for (int j = 0; j < nodes; ++j) {
    const vec3 value = sh_colour<float>(gaussians.sh_degree, sh, shape.mean, eye_at(rig, basis.nodes[j]));
    for (int k = 0; k < nodes; ++k) chebyshev[k] += basis.to_chebyshev[k * nodes + j] * value;
  }
  auto size = [&](int k) { return fmaxf(fabsf(chebyshev[k].x), fmaxf(fabsf(chebyshev[k].y), fabsf(chebyshev[k].z))); };
  // Errors are positive, so their bits order like the numbers
  if (order >= 2) atomicMax(reinterpret_cast<unsigned*>(error), __float_as_uint(size(order) + size(order - 1)));

  // The orders this splat needs, as powers of s
  int kept = order;
  for (float dropped = 0; kept > 0 && (dropped += size(kept)) <= tolerance;) --kept;
  out.orders[i] = kept;
  float4* colours = reinterpret_cast<float4*>(out.colours) + i * nodes;
  for (int p = 0; p <= kept; ++p) {
    vec3 power(0);
    for (int k = p; k <= kept; ++k) power += basis.to_powers[p * nodes + k] * chebyshev[k];
    if (kept == 0) power = glm::max(power, vec3(0));
    colours[p] = make_float4(power.x, power.y, power.z, 0);
  }
}

}  // namespace

void project_dense(const Gaussians<const float>& gaussians, const Cameras<float>& cameras, const Splats<float>& out,
                   uint64_t* keys, Stream stream) {
  if (gaussians.count == 0 || cameras.images() == 0) return;
  const dim3 blocks(unsigned(blocks_for(gaussians.count, kThreads)), unsigned(cameras.images()));
  project_dense_kernel<<<blocks, kThreads, 0, cudaStream_t(stream)>>>(gaussians, cameras, out, keys);
  check_launch("project_dense");
}

void project_lens(const Gaussians<const float>& gaussians, const View<double>& rig, const Lens& lens, double tolerance,
                  const Splats<float>& out, uint64_t* keys, float* error, Stream stream) {
  if (gaussians.count == 0) return;
  const BasisTable basis{ColourBasis(out.colour_order)};
  project_lens_kernel<<<unsigned(blocks_for(gaussians.count, kThreads)), kThreads, 0, cudaStream_t(stream)>>>(
      gaussians, rounded(rig), lens.width_px, lens.height_px, basis, float(tolerance), out, keys, error);
  check_launch("project_lens");
}

}  // namespace lfgs::cuda
