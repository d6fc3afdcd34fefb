// Stage project for a panel on the device: reads Gaussians, writes splats with their colour polynomials and the
// keys by which they are sorted. A thread has a Gaussian.
#include "cuda/common/launch.h"
#include "cuda/direct/project_direct.cuh"
#include "cuda/stages/stages.h"

namespace lfgs::cuda {
namespace {

constexpr int kThreads = 128;

template <int Order, bool kCompensated>
__global__ void project_direct_kernel(Gaussians<const float> gaussians, const __grid_constant__ RoundedRig rig,
                                      int64_t width_px, int64_t height_px, const __grid_constant__ BasisTable basis,
                                      ColourLimits limits, Splats<float> out, uint64_t* keys, unsigned* error) {
  const int64_t i = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (i >= gaussians.count) return;
  const Splat<float> splat =
      store_splat<Order, kCompensated>(gaussians, rig, width_px, height_px, basis, limits, float(kLog2MinAlpha), false,
                                       0, i, out, nullptr, error, [](const auto&...) {});
  keys[i] = splat.reach_y >= 0 ? __float_as_uint(splat.depth) : ~uint64_t(0);
}

}  // namespace

void project_direct(const Gaussians<const float>& gaussians, const Camera<double>& rig, const Lens& lens,
                    double tolerance, const Splats<float>& out, uint64_t* keys, float* error, Stream stream) {
  if (gaussians.count == 0) return;
  const BasisTable basis{ColourBasis(out.colour_order)};
  const unsigned blocks = unsigned(blocks_for(gaussians.count, kThreads));
  with_order(out.colour_order, rig.compensated(), [&](auto order, auto compensated) {
    project_direct_kernel<order, compensated><<<blocks, kThreads, 0, cudaStream_t(stream)>>>(
        gaussians, RoundedRig(rig), lens.width_px, lens.height_px, basis,
        ColourLimits{float(tolerance), float(tolerance)}, out, keys, reinterpret_cast<unsigned*>(error));
  });
  check_launch("project_direct");
}

}  // namespace lfgs::cuda
