// Stage plan of a light-field frame: which kernel composites it.
#include "cuda/check.h"
#include "cuda/lens_plan.cuh"

namespace lfgs::cuda {
namespace {

// Times in ms on an H200, fitted to eight frames (within 12 %): tasks * (cost * hits + set-up) / rate, in warp
// instructions of which it issues 132 x 4 x 1.98 GHz. Hits of a patch of w x h pixels that sees the fraction f of the
// rig: sum of area + (w + f D) 2 b + h 2 a + (w + f D) h over the splats, by their density. Costs of straight shapes
// among curved ones and in half precision follow from counts of instructions.
__global__ void plan_kernel(const __grid_constant__ LensFrame frame) {
  FrameState& state = *frame.state;
  const LensOptics& lens = frame.optics;
  const float pixels = float(lens.width_px) * float(lens.height_px), rate = 1.045e9f;
  const float share = float(sample_stride(frame.splats.count));
  auto sum = [&](int k) { return float(state.sums[k]) / kSumUnit * share; };
  auto hits = [&](float w, float h, float f) {
    return (sum(kArea) + 2 * w * sum(kHalfHeight) + 2 * f * sum(kDisparityHeight) + 2 * h * sum(kHalfWidth) +
            f * h * sum(kDisparity) + w * h * share * float(state.sampled)) / pixels;
  };
  auto mean = [&](int k) { return state.sampled ? float(state.sums[k]) / kErrorUnit / float(state.sampled) : 0.f; };
  const bool linear = mean(kLinearError) <= (frame.in_half ? kMeanHalfShapeError : kMeanShapeError);
  const bool quadratic = mean(kQuadraticError) <= kMeanShapeError;
  const bool mixed = mean(kMixedError) <= kMeanShapeError;
  const float curved = mixed ? mean(kCurved) : 1.f;

  const float large = hits(15, 7, 1), small = hits(15, 3, 1);
  float cost[int(LensKernel::kCount)];
  auto pixel_cost = [&](float each, float of_patch) { return pixels / 128 * (each + of_patch) / rate; };
  const float each = frame.in_half ? 146 : 171, each_small = frame.in_half ? 166 : 191;
  cost[int(LensKernel::kPixel)] = linear ? pixel_cost(each * large, 115) : INFINITY;
  cost[int(LensKernel::kPixelSmall)] = linear ? pixel_cost(each_small * small, 235) : INFINITY;
  // Without a good polynomial every splat costs a division a sample
  cost[int(LensKernel::kPixelQuadratic)] = pixel_cost((quadratic ? 181 + 20 * curved : 416) * large, 115);
  cost[int(LensKernel::kPixelQuadraticSmall)] = quadratic ? pixel_cost((217 + 10 * curved) * small, 235) : INFINITY;
  const float narrowing = 1 / lens.line_number;
  const float across = (1.5f * lens.line_number + 0.5f) / 1.5f + 0.67f;
  const float tasks = 3 * pixels / 64 * ceilf(lens.line_number) / lens.line_number;
  cost[int(LensKernel::kOrdinal)] = frame.has_ordinal
      ? tasks * (60 * hits(across, 15, narrowing * 7 / 6) + 360) / rate : INFINITY;

  int best = int(LensKernel::kPixelQuadratic);
  for (int k = 0; k < int(LensKernel::kCount); ++k)
    if (cost[k] < cost[best]) best = k;
  state.kernel = frame.forced >= 0 ? frame.forced : best;
  state.exact = !quadratic && (state.kernel == int(LensKernel::kPixelQuadratic) ||
                               state.kernel == int(LensKernel::kPixelQuadraticSmall));
  state.straight = mixed ? kStraightError : 0, state.curved = curved;
}

}  // namespace

void frame_plan(const LensFrame& frame, Stream stream) {
  plan_kernel<<<1, 1, 0, cudaStream_t(stream)>>>(frame);
  check_launch("plan");
}

}  // namespace lfgs::cuda
