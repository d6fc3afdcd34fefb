// Backward pass of stage project for a panel on the device: reads the sums of all intersections, writes the
// gradients of the Gaussians. A thread has a Gaussian, and adds up its intersections in their order, so that the bits
// are always the same.
#include "cuda/common/launch.h"
#include "cuda/common/gaussian_io.cuh"
#include "cuda/stages/projection.cuh"
#include "cuda/direct/rounded_rig.cuh"
#include "cuda/stages/stages.h"
#include "math/colour_circle.h"
#include "math/gradient_sums.h"
#include "math/harmonics.h"

namespace lfgs::cuda {
namespace {

using glm::vec3;
constexpr int kThreads = 128;

template <bool kCompensated>
__global__ void __launch_bounds__(kThreads)
    project_direct_backward_kernel(Gaussians<const float> gaussians, const __grid_constant__ RoundedRig rig,
                                   const __grid_constant__ BasisTable basis, Splats<float> splats,
                                   const IntersectionRange* intersection_ranges, const float* intersection_gradients,
                                   Gaussians<float> out) {
  const int64_t i = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (i >= gaussians.count) return;
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
  CameraGradient<double> unused;
  const Projection<double> projection(rig.exact, exact);
  Compensation<double> g_compensation{};
  if constexpr (kCompensated) {
    Splat<double> again = projection.splat(rig.exact, exact.opacity);
    const double most = projection.compensate(rig.exact, again, g_compensation);
    g_compensation = {sum[compensation_at] / most, sum[compensation_at + 1] / most, sum[compensation_at + 2] / most};
  }
  projection.backward<kCompensated>(rig.exact, exact, g_splat, g, unused, g_compensation);

  // The backward pass of the colours, which also depend on the mean
  const float* colours = splats.colours + i * nodes * kColourStride;
  const int64_t first = 3 * gaussians.sh_count() * i;
  if (kept == kCircleOrder) {
    const ColourCircle<double> circle(rig.exact, exact.mean);
    g.mean +=
        circle_colour_backward(gaussians.sh_degree, gaussians.sh + first, circle, sum + kDirectSums, out.sh + first);
    return store_gradient(shape, g, out, i);
  }
  vec3 g_chebyshev[kMaxColourOrder + 1];
  auto to_harmonics = [&](float s, const vec3& g_value) {
    g.mean += sh_colour_backward(gaussians.sh_degree, gaussians.sh + first, shape.mean, rig.rounded.eye_at(s), g_value,
                                 out.sh + first);
  };
  colour_fit_backward(basis, nodes, kept, sum + kDirectSums, colours, g_chebyshev, to_harmonics);
  store_gradient(shape, g, out, i);
}

}  // namespace

void project_direct_backward(const Gaussians<const float>& gaussians, const Camera<double>& rig,
                             const Splats<float>& splats, const IntersectionRange* intersection_ranges,
                             const float* intersection_gradients, const Gaussians<float>& out, Stream stream) {
  if (gaussians.count == 0) return;
  const auto kernel =
      splats.compensations ? project_direct_backward_kernel<true> : project_direct_backward_kernel<false>;
  kernel<<<unsigned(blocks_for(gaussians.count, kThreads)), kThreads, 0, cudaStream_t(stream)>>>(
      gaussians, RoundedRig(rig), BasisTable{ColourBasis(splats.colour_order)}, splats, intersection_ranges,
      intersection_gradients, out);
  check_launch("project_direct_backward");
}

}  // namespace lfgs::cuda
