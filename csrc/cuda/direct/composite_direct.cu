// Stage composite for the panel on the device, and its backward pass, with gradients. The forward pass reads the splats
// and the sorted intersections, and writes the image. The backward pass reads the image and its gradient, and writes
// the sums of every intersection, of the background and, on request, of the samples' offsets.
//
// The list of a tile of pixels has all splats that may touch it, seen from anywhere on the rig. A block draws a tile of
// 32 x 16 pixels, and a warp 16 x 4 of them. A lane has two pixels two rows apart: six sub-pixels, each at its own
// offset.
#include "cuda/common/blend.cuh"
#include "cuda/common/launch.h"
#include "cuda/stages/projection.cuh"
#include "cuda/stages/stages.h"
#include "math/colour_circle.h"
#include "math/colour_polynomial.h"
#include "math/footprint.h"

namespace lfgs::cuda {
namespace {

constexpr int kThreads = 256, kBatch = 128;
constexpr int kWarpWidth = 16, kWarpHeight = 4, kWarpsAcross = 2, kRows = 2;  // kRows: pixels that a lane has
static_assert(kDirectTile.width_px == kWarpWidth * kWarpsAcross);
static_assert(kDirectTile.height_px == kWarpHeight * (kThreads / 32 / kWarpsAcross));

// The backward pass: splats staged at a time, and the most numbers that an intersection has.
constexpr int kBackwardBatch = 16;
template <bool kCompensated>
constexpr int kMostSums = kDirectSums + 3 * (kMaxColourOrder + 1) + (kCompensated ? kCompensationFields : 0);

// A sub-pixel while it is drawn; `rest` is the light left for the background once it has ended, see over().
struct Sample {
  float s;  // normalized offset of its camera
  float colour = 0, transmittance = 0, rest = 0;
  int channel;
};

// The tile of this block, the pixels of this warp, and the pixels of this lane (one below the other, 2 rows apart).
struct ThreadSamples {
  int64_t x0, y0;
  int left, top, column, row;
  float x;

  __device__ explicit ThreadSamples(const Image& image) {
    const int warp = threadIdx.x / 32, lane = threadIdx.x % 32;
    const int64_t across = (image.width_px + kDirectTile.width_px - 1) / kDirectTile.width_px;
    x0 = blockIdx.x % across * kDirectTile.width_px, y0 = blockIdx.x / across * kDirectTile.height_px;
    left = warp % kWarpsAcross * kWarpWidth, top = warp / kWarpsAcross * kWarpHeight;
    column = left + lane % kWarpWidth, row = top + lane / kWarpWidth;
    x = column + 0.5f;
  }
  __device__ int64_t image_row(int r) const { return y0 + row + 2 * r; }
  __device__ bool inside(const Image& image, int r) const {
    return image_row(r) < image.height_px && x0 + column < image.width_px;
  }
  __device__ int64_t pixel(const Image& image, int r) const { return image_row(r) * image.width_px + x0 + column; }

  __device__ Sample sample(const Image& image, const Lens& lens, float s_start, float s_step, int r,
                           int channel) const {
    Sample sample;
    sample.transmittance = inside(image, r) ? 1.f : 0.f;
    const int64_t row = image_row(r), subpixel = lens.subpixel_index(row, x0 + column, channel);
    sample.channel = channel;
    sample.s = fmaf(s_step, float(camera_coordinate(lens, lens.true_phase(row, subpixel))), s_start);
    return sample;
  }
  // Whether a splat, its centre from the tile's corner, may touch the warp's pixels from some camera.
  __device__ bool touches(const Splat<float>& s) const {
    float low, high;
    return footprint_columns(s, top + 0.5f, top + kWarpHeight - 0.5f, 0.f, low, high) && high >= left + 0.5f &&
           low <= left + kWarpWidth - 0.5f;
  }
  // A splat with its centre counted from the corner of the tile.
  __device__ Splat<float> local(Splat<float> s) const {
    s.u0 -= float(x0), s.v0 -= float(y0);
    return s;
  }
};

// Where the camera of a sample sees a splat whose colour is on a circle.
__device__ inline CirclePoint<float> circle_point(const float* colour, const Sample& sample) {
  return {__ldg(colour + kPlaceTerm * kColourStride + 3), __ldg(colour + kDistanceTerm * kColourStride + 3), sample.s};
}

// Colour of a splat at a sample: the polynomial of its channel or the colour on its circle, clamped at zero.
__device__ inline float colour_at(const float* colour, int order, const Sample& sample) {
  if (order == kCircleOrder) {
    auto term = [&](int m) { return __ldg(colour + m * kColourStride + sample.channel); };
    return fmaxf(circle_point(colour, sample).colour(term), 0.f);
  }
  float c = __ldg(colour + order * kColourStride + sample.channel);
  for (int p = order - 1; p >= 0; --p) c = fmaf(c, sample.s, __ldg(colour + p * kColourStride + sample.channel));
  return fmaxf(c, 0.f);
}

// The sums of a colour on a circle over a warp, see kAlongSum; g has the gradients of the colours of a lane's samples.
__device__ __noinline__ void circle_sums(const float* colour, const Sample (&samples)[kRows][3],
                                         const float (&g)[kRows][3], float* out) {
  const int lane = threadIdx.x % 32;
  float along = 0, across = 0;
  for (int c = 0; c < 3; ++c) {
    const int channel = samples[0][c].channel;
    float powers[kCircleTerms] = {};
    for (int r = 0; r < kRows; ++r) {
      const CirclePoint<float> point = circle_point(colour, samples[r][c]);
      const float slope = point.slope([&](int m) { return __ldg(colour + m * kColourStride + channel); });
      const float g_angle = g[r][c] * slope * point.h;
      along += g_angle * point.h, across += g_angle * point.t;
      float even = g[r][c], odd = even * point.h;
      for (int m = 0; m < 4; ++m, even *= point.t) powers[m] += even;
      for (int m = 4; m < kCircleTerms; ++m, odd *= point.t) powers[m] += odd;
    }
    for (int m = 0; m < kCircleTerms; ++m) {
      const float sum = warp_sum(powers[m]);
      if (lane == 0) out[3 * m + channel] = sum;
    }
  }
  along = warp_sum(along), across = warp_sum(across);
  if (lane == 0) out[kAlongSum] = along, out[kAcrossSum] = across;
}

// The derivative of a splat's colour by the offset of a sample, before the colour is clamped at zero.
__device__ inline float colour_slope(const float* colour, int order, const Sample& sample) {
  if (order == kCircleOrder) {  // the angle grows by h^2 / distance
    auto term = [&](int m) { return __ldg(colour + m * kColourStride + sample.channel); };
    const CirclePoint<float> point = circle_point(colour, sample);
    return point.slope(term) * point.h * point.h / __ldg(colour + kDistanceTerm * kColourStride + 3);
  }
  float slope = 0;
  for (int p = order; p >= 1; --p)
    slope = fmaf(slope, sample.s, float(p) * __ldg(colour + p * kColourStride + sample.channel));
  return slope;
}

// The derivative of a quadratic k0 + k1 s + k2 s^2.
__device__ inline float quadratic_slope(float k1, float k2, float s) { return fmaf(2 * k2, s, k1); }

// Write the sums over a warp of the gradients of its samples' offsets, as kLensSums says.
__device__ void offset_sums(const ThreadSamples& mine, const float (&g)[kRows][3], float* out) {
  static_assert(kWarpHeight == kCellPeriod && kWarpWidth % kCellPeriod == 0);
  const int lane = threadIdx.x % 32, column = lane % kWarpWidth;
  float rows = 0, columns = 0;
  for (int r = 0; r < kRows; ++r)
    for (int c = 0; c < 3; ++c) {
      rows += g[r][c] * float(mine.image_row(r)), columns += g[r][c] * float(mine.x0 + mine.column);
      float sum = g[r][c];
      for (int step = kCellPeriod; step < kWarpWidth; step *= 2) sum += __shfl_xor_sync(~0u, sum, step);
      const int place = mine.image_row(r) % kCellPeriod * kCellPeriod + column;
      if (column < kCellPeriod) out[3 * place + c] = sum;
    }
  rows = warp_sum(rows), columns = warp_sum(columns);
  if (lane == 0) out[kPlaceSums] = rows, out[kPlaceSums + 1] = columns;
}

// Draw a tile, a block each. The block stages splats in batches; every warp goes through a batch on its own, and
// passes over the splats that cannot touch its pixels.
template <bool kCompensated>
__global__ void __launch_bounds__(kThreads)
    composite_direct_kernel(Splats<float> splats, Image image, const int64_t* ranges, Intersections intersections,
                            Lens lens, float s_start, float s_step, const float* background, float* out) {
  __shared__ Splat<float> staged[kBatch];
  __shared__ uint32_t ids[kBatch];
  const int lane = threadIdx.x % 32;
  const ThreadSamples mine(image);
  Sample samples[kRows][3];
  for (int r = 0; r < kRows; ++r)
    for (int k = 0; k < 3; ++k) samples[r][k] = mine.sample(image, lens, s_start, s_step, r, k);

  for (int64_t begin = ranges[2 * int64_t(blockIdx.x)], end = ranges[2 * int64_t(blockIdx.x) + 1]; begin < end;
       begin += kBatch) {
    // End the list where no sample takes light any more; else stage the next splats
    bool open = false;
    for (auto& pixel : samples)
      for (auto& sample : pixel) open |= sample.transmittance > 0;
    if (__syncthreads_and(!open)) break;
    const int count = int(min(int64_t(kBatch), end - begin));
    for (int k = threadIdx.x; k < count; k += kThreads) {
      const uint32_t id = sorted_splat(intersections, begin + k);
      staged[k] = mine.local(splats.splats[id]), ids[k] = id;
    }
    __syncthreads();
    if (!__any_sync(~0u, open)) continue;

    // Take 32 at a time: each lane compares one with the warp's pixels, then all lanes blend those that may touch them
    for (int first = 0; first < count; first += 32) {
      const bool touched = first + lane < count && mine.touches(staged[first + lane]);
      for (unsigned todo = __ballot_sync(~0u, touched); todo; todo &= todo - 1) {
        const int k = first + __ffs(todo) - 1;
        const Splat<float>& s = staged[k];
        const uint32_t id = ids[k];
        const int order = splats.orders[id];
        const float* colour = splats.colours + int64_t(id) * (splats.colour_order + 1) * kColourStride;
        Compensation<float> compensation;
        if constexpr (kCompensated) compensation = splats.compensations[id];
#pragma unroll
        for (int r = 0; r < kRows; ++r) {
          const float dy = mine.row + 2 * r + 0.5f - s.v0, A = s.log2_opacity - s.tau * dy * dy;
          const float M0 = mine.x - fmaf(s.c0, dy, s.u0), M1 = fmaf(s.c1, dy, s.du);
#pragma unroll
          for (int c = 0; c < 3; ++c) {
            Sample& sample = samples[r][c];
            const float dx = fmaf(-sample.s, M1, M0), S = fmaf(fmaf(sample.s, s.S2, s.S1), sample.s, s.S0);
            float power = A - __fdividef(dx * dx, S);
            if constexpr (kCompensated) power += log2_compensation(compensation, sample.s, S);
            const float alpha = to_alpha(power);
            if (alpha == 0) continue;
            float weight;
            over(alpha, sample.transmittance, sample.rest, weight);
            sample.colour = fmaf(weight, colour_at(colour, order, sample), sample.colour);
          }
        }
      }
    }
  }

  // Add the background by the light that is left, and store
  for (int r = 0; r < kRows; ++r)
    for (int k = 0; k < 3 && mine.inside(image, r); ++k) {
      const Sample& sample = samples[r][k];
      const float behind = remaining(sample.transmittance, sample.rest) * background[sample.channel];
      out[3 * mine.pixel(image, r) + sample.channel] = sample.colour + behind;
    }
}

// The backward pass: writes the sums of every intersection of a tile, a block each; see over_backward() for the
// formula. It goes over the splats front to back, as forward; a sample's `colour` holds the prefix of the formula. The
// sums over a tile run first within each warp, then over the warps, always in the same order. So the bits are always
// the same. kLens: it also writes the sums of the offsets' gradients.
template <bool kCompensated, bool kLens>
__global__ void __launch_bounds__(kThreads)
    composite_direct_backward_kernel(Splats<float> splats, Image image, const int64_t* ranges,
                                     Intersections intersections, Lens lens, float s_start, float s_step,
                                     const float* pixels, const float* gradient, float* intersection_gradients,
                                     float* tile_background, float* tile_lens) {
  __shared__ Splat<float> staged[kBackwardBatch];
  __shared__ uint32_t indices[kBackwardBatch], ids[kBackwardBatch];
  __shared__ float partial[kThreads / 32][kBackwardBatch][kMostSums<kCompensated>];
  constexpr int kCompensationSums = kCompensated ? kCompensationFields : 0;
  const int warp = threadIdx.x / 32, lane = threadIdx.x % 32,
            compensation_at = kDirectSums + 3 * (splats.colour_order + 1);
  const int all_sums = compensation_at + kCompensationSums;

  // The samples, the gradients of their colours, and the total of the formula, which follows from the image
  const ThreadSamples mine(image);
  Sample samples[kRows][3];
  float g[kRows][3], total[kRows][3];
  [[maybe_unused]] float g_offset[kRows][3] = {};
  for (int r = 0; r < kRows; ++r)
    for (int k = 0; k < 3; ++k) {
      samples[r][k] = mine.sample(image, lens, s_start, s_step, r, k);
      const int64_t at = 3 * mine.pixel(image, r) + samples[r][k].channel;
      g[r][k] = mine.inside(image, r) ? gradient[at] : 0.f;
      total[r][k] = mine.inside(image, r) ? g[r][k] * pixels[at] : 0.f;
    }

  const int64_t end = ranges[2 * int64_t(blockIdx.x) + 1];
  for (int64_t begin = ranges[2 * int64_t(blockIdx.x)]; begin < end; begin += kBackwardBatch) {
    // Stage splats, and where their sums will go
    __syncthreads();
    const int count = int(min(int64_t(kBackwardBatch), end - begin));
    if (threadIdx.x < count) {
      indices[threadIdx.x] = intersections.sorted_indices[begin + threadIdx.x];
      ids[threadIdx.x] = sorted_splat(intersections, begin + threadIdx.x);
      staged[threadIdx.x] = mine.local(splats.splats[ids[threadIdx.x]]);
    }
    __syncthreads();

    // Splat by splat: the gradients of each lane's samples, then the sums over the warp
    for (int k = 0; k < count; ++k) {
      const Splat<float>& s = staged[k];
      float* out = partial[warp][k];
      for (int f = lane; f < all_sums; f += 32) out[f] = 0;
      __syncwarp();
      if (!mine.touches(s)) continue;
      const int order = splats.orders[ids[k]];
      const float* colour = splats.colours + int64_t(ids[k]) * (splats.colour_order + 1) * kColourStride;
      [[maybe_unused]] Compensation<float> compensation, of_D{};
      if constexpr (kCompensated) compensation = splats.compensations[ids[k]];
      float sums[kDirectSums] = {}, term[kRows][3];  // term: gradient of the splat's colour there, times a power of s
      bool lit = false;
      for (int r = 0; r < kRows; ++r) {
        const float dy = mine.row + 2 * r + 0.5f - s.v0, A = s.log2_opacity - s.tau * dy * dy;
        const float M0 = mine.x - fmaf(s.c0, dy, s.u0), M1 = fmaf(s.c1, dy, s.du);
        for (int c = 0; c < 3; ++c) {
          Sample& sample = samples[r][c];
          term[r][c] = 0;
          const float dx = fmaf(-sample.s, M1, M0);
          const float S = fmaf(fmaf(sample.s, s.S2, s.S1), sample.s, s.S0), inverse_S = 1 / S;
          float power = A - dx * dx * inverse_S;
          if constexpr (kCompensated) power += log2_compensation(compensation, sample.s, S);
          const float alpha = sample.transmittance > 0 ? to_alpha(power) : 0.f;
          if (alpha == 0) continue;

          // Over, and its backward pass
          const float before = sample.transmittance;
          float weight;
          over(alpha, sample.transmittance, sample.rest, weight);
          if (sample.transmittance == 0) continue;  // the sample ended before this splat
          lit = true;
          const float value = colour_at(colour, order, sample), v = g[r][c] * value;
          sample.colour += weight * v;
          const float g_alpha = over_backward<false>(alpha, before, v, total[r][c] - sample.colour);

          // From alpha to the exponent, and to the terms of the exponent
          const float gp = power < float(kLog2MaxAlpha) ? g_alpha * alpha * float(kLn2) : 0.f;
          const float e = dx * inverse_S, gx = -2 * gp * e, gS = gp * e * e;
          sums[kPowerSum] += gp, sums[kPowerDySum] += gp * dy, sums[kPowerDy2Sum] += gp * dy * dy;
          sums[kXSum] += gx, sums[kXsSum] += gx * sample.s;
          sums[kXDySum] += gx * dy, sums[kXsDySum] += gx * sample.s * dy;
          sums[kSSum] += gS, sums[kSsSum] += gS * sample.s, sums[kSs2Sum] += gS * sample.s * sample.s;
          if constexpr (kCompensated) {
            // The exponent also has log2 of the compensation, (log2 D - log2 S) / 2
            const float half = gp * float(0.5 / kLn2), gD = half / unfiltered(compensation, sample.s);
            const float of_S = -half * inverse_S;
            sums[kSSum] += of_S, sums[kSsSum] += of_S * sample.s, sums[kSs2Sum] += of_S * sample.s * sample.s;
            of_D.D0 += gD, of_D.D1 += gD * sample.s, of_D.D2 += gD * sample.s * sample.s;
          }

          // The colour, where it was not clamped at zero. A polynomial of order 0 was clamped by the stage project,
          // whose backward pass takes care of that
          term[r][c] = order == 0 || value > 0 ? g[r][c] * weight : 0.f;

          // The offset: the footprint's mean in this row moves by M1, and S(s) and the colour change
          if constexpr (kLens) {
            const float S_slope = quadratic_slope(s.S1, s.S2, sample.s);
            float by_s = e * fmaf(e, S_slope, 2 * M1);
            if constexpr (kCompensated) {
              const float D_slope = quadratic_slope(compensation.D1, compensation.D2, sample.s);
              const float of_D = D_slope / unfiltered(compensation, sample.s);
              by_s += float(0.5 / kLn2) * (of_D - S_slope * inverse_S);
            }
            g_offset[r][c] += gp * by_s + term[r][c] * colour_slope(colour, order, sample);
          }
        }
      }

      // Sums over the warp
      if (!__any_sync(~0u, lit)) continue;
#pragma unroll
      for (int f = 0; f < kDirectSums; ++f) {
        const float sum = warp_sum(sums[f]);
        if (lane == 0) out[f] = sum;
      }
      if constexpr (kCompensated) {
        const float D0 = warp_sum(of_D.D0), D1 = warp_sum(of_D.D1), D2 = warp_sum(of_D.D2);
        if (lane == 0) out[compensation_at] = D0, out[compensation_at + 1] = D1, out[compensation_at + 2] = D2;
      }
      if (order == kCircleOrder) circle_sums(colour, samples, term, out + kDirectSums);
      for (int p = 0; p <= order; ++p)
        for (int c = 0; c < 3; ++c) {
          const float sum = warp_sum(term[0][c] + term[1][c]);
          if (lane == 0) out[kDirectSums + 3 * p + samples[0][c].channel] = sum;
          term[0][c] *= samples[0][c].s, term[1][c] *= samples[1][c].s;
        }
    }
    __syncthreads();

    // Sums over the warps, a number a thread
    for (int i = threadIdx.x; i < count * all_sums; i += kThreads) {
      float sum = 0;
      for (int w = 0; w < kThreads / 32; ++w) sum += partial[w][i / all_sums][i % all_sums];
      intersection_gradients[int64_t(indices[i / all_sums]) * all_sums + i % all_sums] = sum;
    }
  }

  // The gradient of the background: the light that every sample lets through
  __syncthreads();
  for (int c = 0; c < 3; ++c) {
    float behind = 0;
    for (int r = 0; r < kRows; ++r) behind += g[r][c] * remaining(samples[r][c].transmittance, samples[r][c].rest);
    behind = warp_sum(behind);
    if (lane == 0) partial[warp][0][samples[0][c].channel] = behind;
  }
  if constexpr (kLens) offset_sums(mine, g_offset, partial[warp][1]);
  __syncthreads();
  if (threadIdx.x < 3) {
    float sum = 0;
    for (int w = 0; w < kThreads / 32; ++w) sum += partial[w][0][threadIdx.x];
    tile_background[3 * int64_t(blockIdx.x) + threadIdx.x] = sum;
  }
  if constexpr (kLens) {
    static_assert(kLensSums <= kMostSums<kCompensated>);
    if (threadIdx.x < kLensSums) {
      float sum = 0;
      for (int w = 0; w < kThreads / 32; ++w) sum += partial[w][1][threadIdx.x];
      tile_lens[kLensSums * int64_t(blockIdx.x) + threadIdx.x] = sum;
    }
  }
}

}  // namespace

void composite_direct(const Splats<float>& splats, const Image& image, const int64_t* ranges,
                      const Intersections& intersections, const Lens& lens, const float* background, float* out,
                      Stream stream) {
  const int64_t tiles = tile_count(image.tile, image.width_px, image.height_px);
  const float start = float(lens.s_start()), step = float(lens.s_step());
  const auto kernel = splats.compensations ? composite_direct_kernel<true> : composite_direct_kernel<false>;
  kernel<<<unsigned(tiles), kThreads, 0, cudaStream_t(stream)>>>(splats, image, ranges, intersections, lens, start,
                                                                 step, background, out);
  check_launch("composite_direct");
}

void composite_direct_backward(const Splats<float>& splats, const Image& image, const int64_t* ranges,
                               const Intersections& intersections, const Lens& lens, const float* pixels,
                               const float* gradient, float* intersection_gradients, float* tile_background,
                               float* tile_lens, Stream stream) {
  const float start = float(lens.s_start()), step = float(lens.s_step());
  const unsigned tiles = unsigned(tile_count(image.tile, image.width_px, image.height_px));
  const bool compensated = splats.compensations;
  const auto kernel =
      tile_lens
          ? (compensated ? composite_direct_backward_kernel<true, true> : composite_direct_backward_kernel<false, true>)
          : (compensated ? composite_direct_backward_kernel<true, false>
                         : composite_direct_backward_kernel<false, false>);
  kernel<<<tiles, kThreads, 0, cudaStream_t(stream)>>>(splats, image, ranges, intersections, lens, start, step, pixels,
                                                       gradient, intersection_gradients, tile_background, tile_lens);
  check_launch("composite_direct_backward");
}

}  // namespace lfgs::cuda
