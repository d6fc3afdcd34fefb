// How a frame chooses the kernel that composites it: the cost and error of each, averaged over the splats. project
// adds up the sums in FrameState, and the last of its blocks reads them and writes the choice there.
//
// A kernel evaluates r = S^(-1/2) as a polynomial in s. If r has the relative error e, the error of alpha is below 0.74
// e. The error is estimated from the p of RootSeries. A straight line through -+ 1/2 leaves at most about 3/4 (p2 +
// p3). A parabola through 0 and -+ sqrt(1/2) leaves 1/2 (p3 + p4). The average is a third of that. Two terms are taken
// since one alone says little: p2 is zero where s2 = 3/4 s1^2, and p3 where s1 = 0.
#pragma once

#include "cuda/common/blend.cuh"
#include "cuda/frame/direct_frame.h"
#include "cuda/frame/lens_optics.cuh"
#include "cuda/frame/root_series.cuh"
#include "math/constants.h"
#include "math/footprint.h"
#include "math/lattice_plan.h"

namespace lfgs::cuda {

// The largest mean error over the splats of a frame: it keeps 80 dB at 8 bits.
constexpr float kMeanShapeError = 6e-5f;
// Limits for the error of one splat. Up to `straight` a quadratic kernel takes the linear fit; beyond `needs_exact` it
// takes no fit, which costs a division a sample. A frame takes the first level of limits that keeps its mean error.
// 2e-3 is 0.4 of 1/255.
struct ShapeLimits {
  float straight, needs_exact;
};
constexpr int kLevels = 2;
LFGS_HD ShapeLimits shape_limits(int level) {
  return level == 0 ? ShapeLimits{1.6e-4f, 2e-3f} : ShapeLimits{6e-5f, 5e-4f};
}
// The largest mean error, and the limit `needs_exact`, where samples are evaluated in half precision.
constexpr float kMeanHalfShapeError = 1e-3f, kMostHalfShapeError = 5e-3f;
// The limit `needs_exact` of the linear kernels. Colours with harmonics have errors of their own, so that less of what
// 80 dB allow is left for shapes.
__device__ inline float most_linear_error(const DirectFrame& frame) {
  constexpr float kWithHarmonics = 2.4e-4f;
  if (frame.in_half) return kMostHalfShapeError;
  return frame.splats.orders ? kWithHarmonics : shape_limits(0).needs_exact;
}
// log2(0.98): a splat of at least this opacity needs the exact formulas. No other can end a sample that holds more than
// 2/255.
constexpr float kExactOpacity = -0.0291f;
constexpr int kSampledSplats = 1 << 14;  // about so many splats are summed, which is enough for averages

// The sums over splats. First geometry: area of the footprint, half its width and height, disparity over the rig, and
// disparity times half height. Then errors and numbers of splats.
enum FrameSum {
  kArea,
  kHalfWidth,
  kHalfHeight,
  kDisparity,
  kDisparityHeight,
  kLinearError,
  kLinearExact,  // the linear kernels: error of the splats that are fitted; number of the others, which need the exact
                 // formulas
  kMixedError,
  kMixedExact = kMixedError + kLevels,
  kCurved = kMixedExact + kLevels,  // the quadratic kernels, at the limits of each level; kCurved: beyond `straight`
  kLensColumnError = kCurved + kLevels,
  kLensColumnExact,
  kSums
};
static_assert(kSums <= sizeof(FrameState::sums) / sizeof(unsigned long long));
// Sums are in fixed point, so that their order does not matter: these are the units of geometry, and of all others.
constexpr float kSumUnit = 1 << 4, kErrorUnit = 1 << 30;

// The relative error of r, at most, when it is a straight line or a parabola over the rig.
struct ShapeError {
  float linear, quadratic;

  __device__ explicit ShapeError(const Splat<float>& s) {
    const float inverse = fast_reciprocal(s.S0);
    const RootSeries series{s.S1 * inverse, s.S2 * inverse};
    linear = 0.75f * (fabsf(series.p2()) + fabsf(series.p3()));
    quadratic = 0.5f * (fabsf(series.p3()) + fabsf(series.p4()));
    // The series says little of a splat that varies much, so that counts as a large error
    if (fabsf(series.s1) + fabsf(series.s2) > 0.5f) linear = quadratic = 1;
  }
};

// The largest mean error with which the lens column kernel may be chosen. Captures of thin discs have up to 1.0e-4 in
// cones of 53 degrees, and 1.5e-4 in cones of 90. In cones of 150 degrees they have 2.1e-4 and more.
__device__ inline float most_lens_column_error(const DirectFrame& frame) {
  return frame.in_half ? kMeanHalfShapeError : 1.8e-4f;
}

// The splat in the lens-column kernel, from the middle and both ends of the rig. Add the mean error where it does not
// need the exact formulas, and the fraction where it does. The error is 1 if half precision has no number for the sweep
// in standard deviations.
__device__ inline void lens_column_terms(const LensOptics& lens, const Splat<float>& s, float& error,
                                         float& needs_exact) {
  constexpr float kMostHalf = 3e4f;
  const float unit = offset_unit(lens), sweep = fabsf(unit) * (fabsf(s.du) + fabsf(s.c1) * kTileRows);
  bool lost = false;
  for (float centre = -1; centre <= 1; ++centre) {
    const LensColumnShape shape(s, centre, unit);
    const float left = shape.parabola_error(lens.lens_columns, s.log2_opacity);
    if (left > kMostParabolaError)
      needs_exact += 1 / 3.f;
    else
      error += left / 3;
    lost = lost || !(sweep * shape.r < kMostHalf);
  }
  if (lost) error = 1;
}

// One in so many blocks of project adds its splats to the sums.
__host__ __device__ inline unsigned sample_stride(int64_t count) { return unsigned(count / kSampledSplats + 1); }

// Write a splat's terms in the sums of errors and numbers; all are between 0 and 1.
__device__ inline void shape_terms(const DirectFrame& frame, const Splat<float>& s, float terms[kSums]) {
  const ShapeError error(s);
  const bool opaque = !frame.in_half && s.log2_opacity >= kExactOpacity;
  auto set = [&](int of_error, int of_exact, float e, float most) {
    const bool needs_exact = opaque || e > most;
    terms[of_error] = needs_exact ? 0.f : e, terms[of_exact] = float(needs_exact);
  };
  set(kLinearError, kLinearExact, error.linear, most_linear_error(frame));
  for (int level = 0; level < kLevels; ++level) {
    const bool curved = error.linear > shape_limits(level).straight;
    set(kMixedError + level, kMixedExact + level, curved ? error.quadratic : error.linear,
        shape_limits(level).needs_exact);
    terms[kCurved + level] = float(curved);
  }
  if (frame.has_lens_column()) lens_column_terms(frame.optics, s, terms[kLensColumnError], terms[kLensColumnExact]);
}

// Add a splat a thread to the frame's sums; a splat that is not drawn adds nothing. By all threads of a block.
__device__ inline void add_to_sums(const DirectFrame& frame, const Splat<float>& s) {
  // First the block adds up its own: the frame's sums lie side by side in memory, which takes one addition at a time
  __shared__ unsigned long long of_block[kSums];
  __shared__ unsigned drawn_of_block;
  if (threadIdx.x < kSums) of_block[threadIdx.x] = 0;
  if (threadIdx.x == 0) drawn_of_block = 0;
  __syncthreads();

  // The terms of this thread's splat
  unsigned long long terms[kSums] = {};
  if (s.reach_y >= 0) {
    const float range = exponent_left(s, 0.f);
    const float a = fminf(sqrtf(range * s.S0), float(frame.optics.width_px)), D = 2 * fabsf(s.du);
    const float b = fminf(s.reach_y, float(frame.optics.height_px));
    float values[kSums] = {3.14159265f * a * b, a, b, D, b * D};
    shape_terms(frame, s, values);
    for (int k = 0; k < kSums; ++k)
      terms[k] = static_cast<unsigned long long>(k < kLinearError ? fminf(values[k], 1e9f) * kSumUnit
                                                                  : values[k] * kErrorUnit);
  }

  // Their sums over the warp, over the block, and into the frame's
  const unsigned drawn = __popc(__ballot_sync(~0u, s.reach_y >= 0));
  for (int k = 0; k < kSums; ++k)
    for (int step = 16; step > 0; step /= 2) terms[k] += __shfl_xor_sync(~0u, terms[k], step);
  if (threadIdx.x % 32 == 0 && drawn) {
    atomicAdd(&drawn_of_block, drawn);
    for (int k = 0; k < kSums; ++k) atomicAdd(&of_block[k], terms[k]);
  }
  __syncthreads();
  if (threadIdx.x < kSums) atomicAdd(&frame.state->sums[threadIdx.x], of_block[threadIdx.x]);
  if (threadIdx.x == 0) atomicAdd(&frame.state->sampled, drawn_of_block);
}

// How many points a lattice may have in a tile whose splats are this large: drawing so many costs half of what the
// lattice spares. Every point meets the whole list of the tile. A warp of the other kernels has a patch of about a
// quarter of the tile's width and height. It meets only the splats that reach its patch.
__device__ inline float points_worth(float width_px, float height_px) {
  const float w = float(kPixelTileWidth), h = float(kPixelTileHeight);
  return 1250 * (w / 4 + width_px) / (w + width_px) * (h / 4 + height_px) / (h + height_px);
}

// Whether a lattice with a usual number of planes would pay in a tile of usual splats, which have these mean half sizes
// in pixels. It is asked once for the frame: to test every tile takes a tenth of the time of a frame of small splats.
__device__ inline bool lattices_may_pay(const DirectFrame& frame, float half_width, float half_height) {
  constexpr float kPlanes = 7, kReach = 2.65f;  // how many standard deviations a splat of usual opacity reaches
  constexpr float kCoarser = 7 / 6.f;           // coarser than tried first: frames that only just pay so were no slower
  if (!(frame.lattice > 0)) return false;
  const float unit = fminf(kCoarser * first_fineness(frame.lattice), kMostFineness) / kReach;
  const float columns = float(kPixelTileWidth) / (unit * half_width);
  const float rows = float(kPixelTileHeight) / (unit * half_height);
  const float points = kPlanes * (columns + 1) * (rows + 1) + (kPlanes - 1) * columns * rows;
  return points <= points_worth(1.74f * half_width, 1.74f * half_height);
}

// Choose the kernel that draws the frame, and the limits of errors that it keeps. Called by the thread that ends the
// sums, when all of them are there.
//
// Each kernel is given a time in ms on an H200: tasks * (cost of an intersection * intersections + set-up) / rate. The
// costs are in warp instructions; an H200 issues 132 x 4 at 1.98 GHz. They were fitted to the times of frames, within
// 12 %. Take a patch of w x h pixels that sees the fraction f of the rig. Its intersections are the sum, over the
// splats, of
//   area + (w + f D) 2 b + h 2 a + (w + f D) h
// divided by the pixels of the panel. a and b are the half width and half height of a splat, D its disparity. A frame
// of compensated opacities is drawn by lens columns, or by patches of pixels with parabolas, since only these kernels
// know the compensation.
template <bool kCompensated>
__device__ inline void choose_kernel(const DirectFrame& frame) {
  FrameState& state = *frame.state;

  // Read the sums: volatile, since other blocks have just added to them
  float sums[kSums];
  for (int k = 0; k < kSums; ++k) sums[k] = float(static_cast<volatile unsigned long long&>(state.sums[k]));
  const float sampled = float(static_cast<volatile unsigned&>(state.sampled));
  const LensOptics& lens = frame.optics;
  const float pixels = float(lens.width_px) * float(lens.height_px), rate = 1.045e9f;
  const float stride = float(sample_stride(frame.splats.count));
  auto sum = [&](int k) { return sums[k] / kSumUnit * stride; };
  auto intersections = [&](float w, float h, float f) {
    return (sum(kArea) + 2 * w * sum(kHalfHeight) + 2 * f * sum(kDisparityHeight) + 2 * h * sum(kHalfWidth) +
            f * h * sum(kDisparity) + w * h * stride * sampled) /
           pixels;
  };

  // Mean errors, and the first level of limits that keeps the mean of the quadratic kernels. If no level does, they
  // draw all splats by the exact formulas (`exact`)
  auto mean = [&](int k) { return sampled > 0 ? sums[k] / kErrorUnit / sampled : 0.f; };
  const bool linear = !kCompensated && mean(kLinearError) <= (frame.in_half ? kMeanHalfShapeError : kMeanShapeError);
  int level = 0;
  while (level < kLevels && mean(kMixedError + level) > kMeanShapeError) ++level;
  const bool exact = level == kLevels;
  const float curved = exact ? 1 : mean(kCurved + level), needs_exact = exact ? 1 : mean(kMixedExact + level);

  // Costs of the kernels by pixels
  const float large = intersections(15, 7, 1), small = intersections(15, 3, 1);
  float cost[int(FrameKernel::kCount)];
  auto pixel_cost = [&](float each, float of_patch) { return pixels / 128 * (each + of_patch) / rate; };
  auto with_exact = [](float each, float needs_exact) { return each + needs_exact * (416 - each); };
  const float linear_exact = mean(kLinearExact);
  const float each = with_exact(frame.in_half ? 130 : 166, linear_exact);
  const float each_small = with_exact(frame.in_half ? 157 : 187, linear_exact);
  cost[int(FrameKernel::kPixel)] = linear ? pixel_cost(each * large, 500) : INFINITY;
  cost[int(FrameKernel::kPixelSmall)] = linear ? pixel_cost(each_small * small, 556) : INFINITY;
  constexpr float kCompensation = kCompensated ? 24 : 0;  // two operations a sample
  const float quadratic = 187 + kCompensation + 30 * curved, quadratic_small = 236 + kCompensation + 26 * curved;
  cost[int(FrameKernel::kPixelQuadratic)] = pixel_cost(with_exact(quadratic, needs_exact) * large, 500);
  cost[int(FrameKernel::kPixelQuadraticSmall)] = pixel_cost(with_exact(quadratic_small, needs_exact) * small, 556);

  // Cost of the lens column kernel. One exact intersection makes the other 7 of its batch as slow; two square roots a
  // sample take their time
  const float narrowing = 1 / lens.line_number;
  const float across = (1.5f * lens.line_number + 0.5f) / 1.5f + 0.67f;
  const float tasks = 3 * pixels / 64 * ceilf(lens.line_number) / lens.line_number;
  const float exact_batches = 1 - powf(1 - fminf(mean(kLensColumnExact), 1.f), 8);
  const float lens_column_each = 60 * (1 + 0.6f * exact_batches);
  cost[int(FrameKernel::kLensColumn)] =
      frame.has_lens_column() && mean(kLensColumnError) <= most_lens_column_error(frame)
          ? tasks * (lens_column_each * intersections(across, 15, narrowing * 7 / 6) + 360) / rate
          : INFINITY;

  // Write the choice, and the choice without the lens column kernel, see settle_kernel()
  const ShapeLimits limits = shape_limits(exact ? kLevels - 1 : level);
  static_assert(int(FrameKernel::kLensColumn) == int(FrameKernel::kCount) - 1);
  for (const bool without : {false, true}) {
    int best = int(FrameKernel::kPixelQuadratic);
    for (int k = 0; k < int(FrameKernel::kCount) - int(without); ++k)
      if (cost[k] < cost[best]) best = k;
    KernelChoice& choice = without ? state.by_pixels : state.choice;
    choice.kernel = frame.forced >= 0 ? frame.forced : best;
    const bool straight = choice.kernel == int(FrameKernel::kPixel) || choice.kernel == int(FrameKernel::kPixelSmall);
    choice.straight = limits.straight;
    choice.needs_exact = straight ? most_linear_error(frame) : exact ? -1 : limits.needs_exact;
  }
  state.curved = curved;
  const float each_splat = sampled > 0 ? 1 / (kSumUnit * sampled) : 0.f;
  state.lattices = lattices_may_pay(frame, sums[kHalfWidth] * each_splat, sums[kHalfHeight] * each_splat);
}

}  // namespace lfgs::cuda
