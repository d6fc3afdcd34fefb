// Backward pass of stage project for a panel on the device: reads the sums of all intersections, writes the gradients
// of the Gaussians and, on request, of the rig. A thread has a Gaussian, and adds up its intersections in their order.
// A block sums the gradients of the rig over its Gaussians. So the bits are always the same.
#include "cuda/common/blend.cuh"
#include "cuda/common/launch.h"
#include "cuda/common/gaussian_io.cuh"
#include "cuda/stages/projection.cuh"
#include "cuda/direct/rounded_rig.cuh"
#include "cuda/stages/stages.h"
#include "math/colour_circle.h"
#include "math/gradient_sums.h"
#include "math/harmonics.h"
#include "math/rig_gradient.h"

namespace lfgs::cuda {
namespace {

using glm::vec3;
constexpr int kThreads = 128;

// Write the gradients of Gaussian i, and with kRig add to those of the rig.
template <bool kCompensated, bool kRig>
__device__ void gaussian_backward(const Gaussians<const float>& gaussians, const RoundedRig& rig,
                                  const BasisTable& basis, const Splats<float>& splats,
                                  const IntersectionRange* intersection_ranges, const float* intersection_gradients,
                                  const Gaussians<float>& out, int64_t i, RigGradient& of_rig) {
  const IntersectionRange indices = intersection_ranges[i];
  if (indices.first == indices.last) return;

  // The sums over the splat's intersections: of its shape, its colours, and with compensation its compensation
  const Splat<float> s = splats.splats[i];
  const int order = basis.order, nodes = order + 1, compensation_at = kDirectSums + 3 * nodes, kept = splats.orders[i];
  constexpr int kCompensationSums = kCompensated ? kCompensationFields : 0;
  const int all_sums = compensation_at + kCompensationSums;
  double sum[kDirectSums + 3 * (kMaxColourOrder + 1) + kCompensationSums];
  for (int f = 0; f < all_sums; ++f) sum[f] = 0;
  for (int64_t index = indices.first; index < indices.last; ++index)
    for (int f = 0; f < all_sums; ++f) sum[f] += intersection_gradients[index * all_sums + f];

  // The backward pass of the projection. It is in double, since the covariance of a long needle has no digits left in
  // float. That costs little: a Gaussian has only one projection
  const Splat<double> g_splat = direct_gradient(s, sum);
  const Shape<float> shape = load_shape<float>(gaussians, i);
  const Shape<double> exact = widened(shape);
  Shape<double> g{glm::dvec3(0), glm::dvec4(0), glm::dvec3(0), 0};
  const Projection<double> projection(rig.exact, exact);
  Compensation<double> g_compensation{};
  if constexpr (kCompensated) {
    Splat<double> again = projection.splat(rig.exact, exact.opacity);
    const double most = projection.compensate(rig.exact, again, g_compensation);
    g_compensation = {sum[compensation_at] / most, sum[compensation_at + 1] / most, sum[compensation_at + 2] / most};
  }
  projection.backward<kCompensated>(rig.exact, exact, g_splat, g, of_rig.pose, g_compensation,
                                    kRig ? &of_rig.optics : nullptr);

  // The backward pass of the colours, which also depend on the mean
  const float* colours = splats.colours + i * nodes * kColourStride;
  const int64_t first = 3 * gaussians.sh_count() * i;
  if (kept == kCircleOrder) {
    const ColourCircle<double> circle(rig.exact, exact.mean);
    [[maybe_unused]] CircleGradient<double> g_circle;
    const glm::dvec3 g_mean = circle_colour_backward(gaussians.sh_degree, gaussians.sh + first, circle,
                                                     sum + kDirectSums, out.sh + first, kRig ? &g_circle : nullptr);
    g.mean += g_mean;
    if constexpr (kRig) of_rig.add_circle(rig.exact, circle, g_circle, g_mean);
    return store_gradient(shape, g, out, i);
  }
  vec3 g_chebyshev[kMaxColourOrder + 1];
  auto to_harmonics = [&](float s, const vec3& g_value) {
    const vec3 g_mean = sh_colour_backward(gaussians.sh_degree, gaussians.sh + first, shape.mean, rig.rounded.eye_at(s),
                                           g_value, out.sh + first);
    g.mean += g_mean;
    if constexpr (kRig) of_rig.add_eye(rig.exact, s, -glm::dvec3(g_mean));
  };
  colour_fit_backward(basis, nodes, kept, sum + kDirectSums, colours, g_chebyshev, to_harmonics);
  store_gradient(shape, g, out, i);
}

template <bool kCompensated, bool kRig>
__global__ void __launch_bounds__(kThreads)
    project_direct_backward_kernel(Gaussians<const float> gaussians, const __grid_constant__ RoundedRig rig,
                                   const __grid_constant__ BasisTable basis, Splats<float> splats,
                                   const IntersectionRange* intersection_ranges, const float* intersection_gradients,
                                   Gaussians<float> out, double* rig_partials) {
  const int64_t i = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  RigGradient of_rig;
  if (i < gaussians.count)
    gaussian_backward<kCompensated, kRig>(gaussians, rig, basis, splats, intersection_ranges, intersection_gradients,
                                          out, i, of_rig);
  if constexpr (kRig) {
    __shared__ double partial[kThreads / 32][kRigNumbers];
    of_rig.to_pose(rig.exact);
    store_block_sums([&](int k) { return of_rig.number(k); }, partial, rig_partials + kRigNumbers * blockIdx.x);
  }
}

}  // namespace

int64_t rig_blocks(int64_t gaussians) { return blocks_for(gaussians, kThreads); }

void project_direct_backward(const Gaussians<const float>& gaussians, const Camera<double>& rig,
                             const Splats<float>& splats, const IntersectionRange* intersection_ranges,
                             const float* intersection_gradients, const Gaussians<float>& out, double* rig_partials,
                             Stream stream) {
  if (gaussians.count == 0) return;
  const bool compensated = splats.compensations;
  const auto kernel =
      rig_partials
          ? (compensated ? project_direct_backward_kernel<true, true> : project_direct_backward_kernel<false, true>)
          : (compensated ? project_direct_backward_kernel<true, false> : project_direct_backward_kernel<false, false>);
  kernel<<<unsigned(rig_blocks(gaussians.count)), kThreads, 0, cudaStream_t(stream)>>>(
      gaussians, RoundedRig(rig), BasisTable{ColourBasis(splats.colour_order)}, splats, intersection_ranges,
      intersection_gradients, out, rig_partials);
  check_launch("project_direct_backward");
}

}  // namespace lfgs::cuda
