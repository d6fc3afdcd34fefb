// How composite goes about a frame: errors and costs of its kernels, averaged over splats.
//
// A kernel evaluates r = S^(-1/2) as a polynomial in s; with relative error e of r, alpha is wrong by less than 0.74 e.
// With the p of RootSeries, interpolation leaves at most about 3/4 (p2 + p3) with a straight line through -+ 1/2,
// 1/2 (p3 + p4) with a parabola through 0 and -+ sqrt(1/2); a third on average. One term alone says little: p2 is zero
// where s2 = 3/4 s1^2, p3 where s1 = 0.
#pragma once

#include "cuda/common/blend.cuh"
#include "cuda/frame/lens_frame.h"
#include "cuda/frame/lens_optics.cuh"
#include "cuda/frame/root_series.cuh"
#include "math/constants.h"
#include "math/footprint.h"
#include "math/lattice_plan.h"

namespace lfgs::cuda {

constexpr float kMeanShapeError = 6e-5f;  // of a frame, the mean over splats: keeps 80 dB at 8 bits
// Of one splat: up to `straight` a quadratic kernel takes the linear fit, beyond `careful` none, which costs a division
// a sample. A frame takes the first limits that keep its mean; 2e-3 is 0.4 of 1/255.
struct ShapeLimits {
  float straight, careful;
};
constexpr int kLevels = 2;
LFGS_HD ShapeLimits shape_limits(int level) {
  return level == 0 ? ShapeLimits{1.6e-4f, 2e-3f} : ShapeLimits{6e-5f, 5e-4f};
}
// The mean, and `careful`, where samples are halves.
constexpr float kMeanHalfShapeError = 1e-3f, kMostHalfShapeError = 5e-3f;
// `careful` of the linear fits. Colours with harmonics have errors of their own, that leave less of the 80 dB.
__device__ inline float most_linear_error(const LensFrame& frame) {
  constexpr float kWithHarmonics = 2.4e-4f;
  if (frame.in_half) return kMostHalfShapeError;
  return frame.splats.orders ? kWithHarmonics : shape_limits(0).careful;
}
constexpr float kCarefulOpacity = -0.0291f;  // log2(0.98): what an opaque splat stops is less than 2/255
constexpr int kSampledSplats = 1 << 14;      // about; enough for averages

enum FrameSum {
  kArea,
  kHalfWidth,
  kHalfHeight,
  kDisparity,
  kDisparityHeight,
  kLinearError,
  kLinearCareful,  // of the linear fit, where it is good enough; splats that are evaluated carefully
  kMixedError,
  kMixedCareful = kMixedError + kLevels,
  kCurved = kMixedCareful + kLevels,  // at every level's limits
  kOrdinalError = kCurved + kLevels,
  kOrdinalCareful,
  kSums
};
static_assert(kSums <= sizeof(FrameState::sums) / sizeof(unsigned long long));
constexpr float kSumUnit = 1 << 4, kErrorUnit = 1 << 30;  // fixed point, so that sums have no order

struct ShapeError {
  float linear, quadratic;

  __device__ explicit ShapeError(const Splat<float>& s) {
    const float inverse = fast_reciprocal(s.S0);
    const RootSeries series{s.S1 * inverse, s.S2 * inverse};
    linear = 0.75f * (fabsf(series.p2()) + fabsf(series.p3()));
    quadratic = 0.5f * (fabsf(series.p3()) + fabsf(series.p4()));
    // Series of what varies much say little
    if (fabsf(series.s1) + fabsf(series.s2) > 0.5f) linear = quadratic = 1;
  }
};

// Of the ordinal kernel, the mean of the errors below. Captures of thin discs have up to 1.0e-4 in cones of 53 degrees,
// 1.5e-4 in 90; cones of 150 degrees 2.1e-4 and more.
__device__ inline float most_ordinal_error(const LensFrame& frame) {
  return frame.in_half ? kMeanHalfShapeError : 1.8e-4f;
}

// In the ordinal kernel, of the ends and the middle of the rig: the mean error of what is not careful there, 1 if the
// sweep in standard deviations is no number in half precision; the share that is careful.
__device__ inline void ordinal_terms(const LensOptics& lens, const Splat<float>& s, float& error, float& careful) {
  constexpr float kMostHalf = 3e4f;
  const float unit = offset_unit(lens), sweep = fabsf(unit) * (fabsf(s.du) + fabsf(s.c1) * kTileRows);
  bool lost = false;
  for (float centre = -1; centre <= 1; ++centre) {
    const OrdinalShape shape(s, centre, unit);
    const float left = shape.parabola_error(lens.ordinals, s.log2_opacity);
    if (left > kMostParabolaError)
      careful += 1 / 3.f;
    else
      error += left / 3;
    lost = lost || !(sweep * shape.r < kMostHalf);
  }
  if (lost) error = 1;
}

__host__ __device__ inline unsigned sample_stride(int64_t count) { return unsigned(count / kSampledSplats + 1); }

// Adds a splat's terms, all between 0 and 1 but for those of geometry.
__device__ inline void shape_terms(const LensFrame& frame, const Splat<float>& s, float terms[kSums]) {
  const ShapeError error(s);
  const bool opaque = !frame.in_half && s.log2_opacity >= kCarefulOpacity;
  auto set = [&](int of_error, int of_careful, float e, float most) {
    const bool careful = opaque || e > most;
    terms[of_error] = careful ? 0.f : e, terms[of_careful] = float(careful);
  };
  set(kLinearError, kLinearCareful, error.linear, most_linear_error(frame));
  for (int level = 0; level < kLevels; ++level) {
    const bool curved = error.linear > shape_limits(level).straight;
    set(kMixedError + level, kMixedCareful + level, curved ? error.quadratic : error.linear,
        shape_limits(level).careful);
    terms[kCurved + level] = float(curved);
  }
  if (frame.has_ordinal) ordinal_terms(frame.optics, s, terms[kOrdinalError], terms[kOrdinalCareful]);
}

// By all threads of a block; what is not drawn adds nothing.
__device__ inline void add_to_sums(const LensFrame& frame, const Splat<float>& s) {
  // A block adds what it has as a whole: the sums of all lie side by side, and take one number at a time
  __shared__ unsigned long long of_block[kSums];
  __shared__ unsigned drawn_of_block;
  if (threadIdx.x < kSums) of_block[threadIdx.x] = 0;
  if (threadIdx.x == 0) drawn_of_block = 0;
  __syncthreads();
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

// How many points of a lattice cost as much as half of what they spare, where splats are so large. Every point meets
// the whole list; of what draws the tile otherwise, a piece of a quarter of its width and height meets the splats that
// reach it.
__device__ inline float points_worth(float width_px, float height_px) {
  const float w = float(kPixelTileWidth), h = float(kPixelTileHeight);
  return 1250 * (w / 4 + width_px) / (w + width_px) * (h / 4 + height_px) / (h + height_px);
}

// Whether a lattice of a usual number of planes would pay in a tile of the frame's usual splats, of these mean half
// sizes: to find out in every tile takes a tenth of a frame of small ones.
__device__ inline bool lattices_may_pay(const LensFrame& frame, float half_width, float half_height) {
  constexpr float kPlanes = 7, kReach = 2.65f;  // what a splat of usual opacity reaches, in a plan's units
  constexpr float kCoarser = 7 / 6.f;           // than tried first: frames that just pay so were no slower
  if (!(frame.lattice > 0)) return false;
  const float unit = fminf(kCoarser * first_fineness(frame.lattice), kMostFineness) / kReach;
  const float columns = float(kPixelTileWidth) / (unit * half_width);
  const float rows = float(kPixelTileHeight) / (unit * half_height);
  const float points = kPlanes * (columns + 1) * (rows + 1) + (kPlanes - 1) * columns * rows;
  return points <= points_worth(1.74f * half_width, 1.74f * half_height);
}

// Times in ms on an H200, fitted to frames (within 12 %): tasks * (cost * hits + set-up) / rate, in warp instructions
// of which it issues 132 x 4 x 1.98 GHz. Hits of a patch of w x h pixels that sees the fraction f of the rig: sum of
// area + (w + f D) 2 b + h 2 a + (w + f D) h over the splats, by their density. By the thread that ends the sums.
// An anti-aliased frame is drawn by ordinals, or by patches of pixels with parabolas: nothing else knows of shares of
// opacity.
template <bool kAntialiased>
__device__ inline void choose_kernel(const LensFrame& frame) {
  FrameState& state = *frame.state;
  float sums[kSums];  // that other blocks have just added to
  for (int k = 0; k < kSums; ++k) sums[k] = float(static_cast<volatile unsigned long long&>(state.sums[k]));
  const float sampled = float(static_cast<volatile unsigned&>(state.sampled));
  const LensOptics& lens = frame.optics;
  const float pixels = float(lens.width_px) * float(lens.height_px), rate = 1.045e9f;
  const float share = float(sample_stride(frame.splats.count));
  auto sum = [&](int k) { return sums[k] / kSumUnit * share; };
  auto hits = [&](float w, float h, float f) {
    return (sum(kArea) + 2 * w * sum(kHalfHeight) + 2 * f * sum(kDisparityHeight) + 2 * h * sum(kHalfWidth) +
            f * h * sum(kDisparity) + w * h * share * sampled) /
           pixels;
  };
  auto mean = [&](int k) { return sampled > 0 ? sums[k] / kErrorUnit / sampled : 0.f; };
  const bool linear = !kAntialiased && mean(kLinearError) <= (frame.in_half ? kMeanHalfShapeError : kMeanShapeError);
  int level = 0;
  while (level < kLevels && mean(kMixedError + level) > kMeanShapeError) ++level;
  const bool exact = level == kLevels;
  const float curved = exact ? 1 : mean(kCurved + level), careful = exact ? 1 : mean(kMixedCareful + level);

  const float large = hits(15, 7, 1), small = hits(15, 3, 1);
  float cost[int(LensKernel::kCount)];
  auto pixel_cost = [&](float each, float of_patch) { return pixels / 128 * (each + of_patch) / rate; };
  auto with_careful = [](float each, float careful) { return each + careful * (416 - each); };
  const float linear_careful = mean(kLinearCareful);
  const float each = with_careful(frame.in_half ? 130 : 166, linear_careful);
  const float each_small = with_careful(frame.in_half ? 157 : 187, linear_careful);
  cost[int(LensKernel::kPixel)] = linear ? pixel_cost(each * large, 500) : INFINITY;
  cost[int(LensKernel::kPixelSmall)] = linear ? pixel_cost(each_small * small, 556) : INFINITY;
  constexpr float kShare = kAntialiased ? 24 : 0;  // two operations a sample
  const float quadratic = 187 + kShare + 30 * curved, quadratic_small = 236 + kShare + 26 * curved;
  cost[int(LensKernel::kPixelQuadratic)] = pixel_cost(with_careful(quadratic, careful) * large, 500);
  cost[int(LensKernel::kPixelQuadraticSmall)] = pixel_cost(with_careful(quadratic_small, careful) * small, 556);
  const float narrowing = 1 / lens.line_number;
  const float across = (1.5f * lens.line_number + 0.5f) / 1.5f + 0.67f;
  const float tasks = 3 * pixels / 64 * ceilf(lens.line_number) / lens.line_number;
  // A careful hit makes so of the 8 of its batch; two square roots a sample take their time
  const float careful_batches = 1 - powf(1 - fminf(mean(kOrdinalCareful), 1.f), 8);
  const float ordinal_each = 60 * (1 + 0.6f * careful_batches);
  cost[int(LensKernel::kOrdinal)] = frame.has_ordinal && mean(kOrdinalError) <= most_ordinal_error(frame)
                                        ? tasks * (ordinal_each * hits(across, 15, narrowing * 7 / 6) + 360) / rate
                                        : INFINITY;

  int best = int(LensKernel::kPixelQuadratic);
  for (int k = 0; k < int(LensKernel::kCount); ++k)
    if (cost[k] < cost[best]) best = k;
  state.kernel = frame.forced >= 0 ? frame.forced : best;
  const bool straight = state.kernel == int(LensKernel::kPixel) || state.kernel == int(LensKernel::kPixelSmall);
  const ShapeLimits limits = shape_limits(exact ? kLevels - 1 : level);
  state.straight = limits.straight, state.curved = curved;
  const float each_splat = sampled > 0 ? 1 / (kSumUnit * sampled) : 0.f;
  state.lattices = lattices_may_pay(frame, sums[kHalfWidth] * each_splat, sums[kHalfHeight] * each_splat);
  state.careful = straight ? most_linear_error(frame) : exact ? -1 : limits.careful;
}

}  // namespace lfgs::cuda
