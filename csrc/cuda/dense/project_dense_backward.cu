// Reverse of stage project for ordinary images on the device: reads the sums of all slots, writes the gradients of the
// Gaussians and of the cameras. A thread has a Gaussian of a scene, and goes through the cameras of the scene in order;
// a block adds up what its Gaussians say of each camera.
#include "cuda/common/blend.cuh"
#include "cuda/common/check.h"
#include "cuda/common/gaussian_io.cuh"
#include "cuda/common/widened.cuh"
#include "cuda/stages/stages.h"
#include "math/gradient_sums.h"
#include "math/harmonics.h"
#include "math/saturate.h"

namespace lfgs::cuda {
namespace {

using glm::vec3;
constexpr int kThreads = 128, kWarps = kThreads / 32, kViewNumbers = 12;

// Adds up the slots of a splat, and turns the sums into the gradients of the splat and of its colour.
template <class R>
__device__ Splat<R> splat_gradient(const Splat<float>& s, const float* slot_gradients, SlotRange slots, vec3& colour) {
  static_assert(kDenseSums % 2 == 0);
  R sum[kDenseSums] = {};
  for (uint32_t slot = slots.first; slot < slots.last; ++slot) {
    const float2* own = reinterpret_cast<const float2*>(slot_gradients + int64_t(slot) * kDenseSums);
    for (int f = 0; f < kDenseSums / 2; ++f) {
      const float2 two = own[f];
      sum[2 * f] += two.x, sum[2 * f + 1] += two.y;
    }
  }
  Splat<R> g = dense_gradient_of(s, sum);
  g.depth = sum[kDepthSum];
  colour = vec3(sum[kColourSum], sum[kColourSum + 1], sum[kColourSum + 2]);
  return g;
}

// Whether a splat is so long and thin that its covariance has few digits left in float. The measure is
// rho^2 / (1 - rho^2), where rho is the correlation of x and y.
__device__ bool is_needle(const Splat<float>& s) {
  constexpr float kLong = 300;
  return !(s.c0 * s.c0 <= kLong * s.tau * s.S0);
}

// Adds the adjoint of the projection, from the sums over slots on, computed in double and then rounded. It is not
// inlined, since it is rarely called and takes many registers.
template <bool kAntialiased>
__device__ __noinline__ void add_exact_adjoint(const View<float>& view, const Shape<float>& shape,
                                               const Splat<float>& splat, const float* slot_gradients, SlotRange slots,
                                               Shape<float>& g, ViewAdjoint<float>& g_view, vec3& g_colour) {
  const View<double> exact = widened(view);
  const Shape<double> wide = widened(shape);
  Splat<double> gradient = splat_gradient<double>(splat, slot_gradients, slots, g_colour);
  Shape<double> sum{glm::dvec3(0), glm::dvec4(0), glm::dvec3(0), 0};
  ViewAdjoint<double> of_view;

  // The adjoint, in double
  const Projection<double> projection(exact, wide);
  Compensation<double> sharp{};
  if (kAntialiased) sharp = projection.compensate_adjoint(gradient);
  projection.adjoint<kAntialiased>(exact, wide, gradient, sum, of_view, sharp);

  // Add it to what other cameras have said
  auto add = [](float& to, double what) { to = saturated<float>(to + what); };
  for (int c = 0; c < 3; ++c) add(g.mean[c], sum.mean[c]), add(g.scale[c], sum.scale[c]);
  for (int c = 0; c < 4; ++c) add(g.quaternion[c], sum.quaternion[c]);
  add(g.opacity, sum.opacity);
  for (int c = 0; c < 3; ++c) {
    add(g_view.translation[c], of_view.translation[c]);
    for (int r = 0; r < 3; ++r) add(g_view.rotation[c][r], of_view.rotation[c][r]);
  }
}

// Writes all gradients. The adjoint of an ordinary splat fits the registers that three blocks on a multiprocessor
// leave. Needles, and all splats of an anti-aliased scene (see compensated_splat()), go through add_exact_adjoint()
// instead.
template <bool kAntialiased>
__global__ void __launch_bounds__(kThreads, 3)
    project_dense_backward_kernel(Gaussians<const float> gaussians, Cameras<float> cameras, Splats<float> splats,
                                  const SlotRange* slot_ranges, const float* slot_gradients, Gaussians<float> out,
                                  float* view_partials) {
  __shared__ float partial[kWarps][kViewNumbers];
  const int64_t i = int64_t(blockIdx.x) * kThreads + threadIdx.x, scene = blockIdx.y, n = gaussians.count;
  const bool real = i < n;
  const Gaussians<const float> own = gaussians.slice(scene * n);
  const Gaussians<float> g_own = out.slice(scene * n);
  const Shape<float> shape = shape_of(own, real ? i : 0);
  const int numbers = 3 * own.sh_count();
  Shape<float> g{vec3(0), glm::vec4(0), vec3(0), 0};

  for (int64_t v = 0; v < cameras.per_scene; ++v) {
    const int64_t image = scene * cameras.per_scene + v;
    const View<float> view = cameras.view<float>(image);
    const int64_t index = image * n + i;
    const SlotRange slots = real ? slot_ranges[index] : SlotRange{0, 0};
    ViewAdjoint<float> g_view;
    if (slots.first < slots.last) {
      vec3 g_colour;
      const Splat<float> splat = read_splat(splats.splats + index);
      if (kAntialiased || is_needle(splat)) {
        add_exact_adjoint<kAntialiased>(view, shape, splat, slot_gradients, slots, g, g_view, g_colour);
      } else {
        const Splat<float> g_splat = splat_gradient<float>(splat, slot_gradients, slots, g_colour);
        Projection<float>(view, shape).adjoint(view, shape, g_splat, g, g_view);
      }

      // The colours, through their clamp at zero; they also depend on the eye, which is -R^T t
      const float* colour = splats.colours + index * kColourStride;
      for (int c = 0; c < 3; ++c) g_colour[c] = colour[c] > 0 ? g_colour[c] : 0.f;
      const vec3 g_mean = sh_colour_adjoint(own.sh_degree, own.sh + numbers * i, shape.mean, view.centre(), g_colour,
                                            g_own.sh + numbers * i);
      g.mean += g_mean;
      g_view.rotation += glm::outerProduct(-view.translation, -g_mean);
      g_view.translation += view.rotation * g_mean;
    }

    // The camera's gradient, summed over each warp, then over the warps
    for (int f = 0; f < kViewNumbers; ++f) {
      const float sum = warp_sum(f % 4 == 3 ? g_view.translation[f / 4] : g_view.rotation[f % 4][f / 4]);
      if (threadIdx.x % 32 == 0) partial[threadIdx.x / 32][f] = sum;
    }
    __syncthreads();
    if (threadIdx.x < kViewNumbers) {
      float sum = 0;
      for (int w = 0; w < kWarps; ++w) sum += partial[w][threadIdx.x];
      view_partials[(image * gridDim.x + blockIdx.x) * kViewNumbers + threadIdx.x] = sum;
    }
    __syncthreads();
  }
  if (real) store_gradient(shape, g, g_own, i);
}

}  // namespace

int64_t view_blocks(int64_t gaussians) { return blocks_for(gaussians, kThreads); }

void project_dense_backward(const Gaussians<const float>& gaussians, const Cameras<float>& cameras,
                            const Splats<float>& splats, const SlotRange* slot_ranges, const float* slot_gradients,
                            const Gaussians<float>& out, float* view_partials, Stream stream) {
  if (gaussians.count == 0 || cameras.scenes == 0) return;
  const dim3 blocks(unsigned(view_blocks(gaussians.count)), unsigned(cameras.scenes));
  const auto kernel = cameras.antialiased ? project_dense_backward_kernel<true> : project_dense_backward_kernel<false>;
  kernel<<<blocks, kThreads, 0, cudaStream_t(stream)>>>(gaussians, cameras, splats, slot_ranges, slot_gradients, out,
                                                        view_partials);
  check_launch("project_dense_backward");
}

}  // namespace lfgs::cuda
