// Reverse of stage project for the lens sensor on the device: reads the sums of all slots, writes the gradients of the
// Gaussians. A thread has a Gaussian, and adds up its slots in their order, so that the bits are always the same.
#include "cuda/common/check.h"
#include "cuda/common/gaussian_io.cuh"
#include "cuda/common/widened.cuh"
#include "cuda/lens/lens_rig.cuh"
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
    project_lens_backward_kernel(Gaussians<const float> gaussians, const __grid_constant__ Rig rig,
                                 const __grid_constant__ BasisTable basis, Splats<float> splats,
                                 const SlotRange* slot_ranges, const float* slot_gradients, Gaussians<float> out) {
  const int64_t i = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (i >= gaussians.count) return;
  const SlotRange slots = slot_ranges[i];
  if (slots.first == slots.last) return;

  // The sums over the splat's slots: of its shape, its colours, and with compensation its compensation
  const Splat<float> s = splats.splats[i];
  const int order = basis.order, nodes = order + 1, sharp = kLensSums + 3 * nodes, kept = splats.orders[i];
  constexpr int kSharp = kCompensated ? kCompensationFields : 0;
  const int all_sums = sharp + kSharp;
  double sum[kLensSums + 3 * (kMaxColourOrder + 1) + kSharp];
  for (int f = 0; f < all_sums; ++f) sum[f] = 0;
  for (int64_t slot = slots.first; slot < slots.last; ++slot)
    for (int f = 0; f < all_sums; ++f) sum[f] += slot_gradients[slot * all_sums + f];

  // The adjoint of the projection. It is in double, since the covariance of a long needle has no digits left in float;
  // that costs little, for a Gaussian has but one projection
  const Splat<double> g_splat = lens_gradient_of(s, sum);
  const Shape<float> shape = shape_of(gaussians, i);
  const Shape<double> exact = widened(shape);
  Shape<double> g{glm::dvec3(0), glm::dvec4(0), glm::dvec3(0), 0};
  ViewAdjoint<double> unused;
  const Projection<double> projection(rig.exact, exact);
  Compensation<double> g_sharp{};
  if constexpr (kCompensated) {
    Splat<double> again = projection.splat(rig.exact, exact.opacity);
    const double most = projection.compensate(rig.exact, again, g_sharp);
    g_sharp = {sum[sharp] / most, sum[sharp + 1] / most, sum[sharp + 2] / most};
  }
  projection.adjoint<kCompensated>(rig.exact, exact, g_splat, g, unused, g_sharp);

  // The adjoint of the colours, which also depend on the mean
  const float* colours = splats.colours + i * nodes * kColourStride;
  const int64_t first = 3 * gaussians.sh_count() * i;
  if (kept == kCircleOrder) {
    const ColourCircle<double> circle(rig.exact, exact.mean);
    g.mean += circle_colour_adjoint(gaussians.sh_degree, gaussians.sh + first, circle, sum + kLensSums, out.sh + first);
    return store_gradient(shape, g, out, i);
  }
  vec3 g_chebyshev[kMaxColourOrder + 1];
  auto to_harmonics = [&](float s, const vec3& g_value) {
    g.mean += sh_colour_adjoint(gaussians.sh_degree, gaussians.sh + first, shape.mean, rig.rounded.eye_at(s), g_value,
                                out.sh + first);
  };
  colour_fit_adjoint(basis, nodes, kept, sum + kLensSums, colours, g_chebyshev, to_harmonics);
  store_gradient(shape, g, out, i);
}

}  // namespace

void project_lens_backward(const Gaussians<const float>& gaussians, const View<double>& rig,
                           const Splats<float>& splats, const SlotRange* slot_ranges, const float* slot_gradients,
                           const Gaussians<float>& out, Stream stream) {
  if (gaussians.count == 0) return;
  const auto kernel = splats.compensations ? project_lens_backward_kernel<true> : project_lens_backward_kernel<false>;
  kernel<<<unsigned(blocks_for(gaussians.count, kThreads)), kThreads, 0, cudaStream_t(stream)>>>(
      gaussians, Rig(rig), BasisTable{ColourBasis(splats.colour_order)}, splats, slot_ranges, slot_gradients, out);
  check_launch("project_lens_backward");
}

}  // namespace lfgs::cuda
