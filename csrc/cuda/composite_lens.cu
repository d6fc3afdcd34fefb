// Stage composite for the panel on the device: pixel tiles swept over the whole rig. A block has a tile of 32 x 16
// pixels, a warp 16 x 4 of them, a lane two pixels one below the other: six sub-pixels, each at its own offset.
#include "cuda/blend.cuh"
#include "cuda/check.h"
#include "cuda/stages.h"
#include "math/footprint.h"

namespace lfgs::cuda {
namespace {

constexpr int kThreads = 256, kBatch = 128;
constexpr int kWarpWidth = 16, kWarpHeight = 4, kWarpsAcross = 2, kRows = 2;  // kRows: pixels of a lane
static_assert(kLensTile.width_px == kWarpWidth * kWarpsAcross);
static_assert(kLensTile.height_px == kWarpHeight * (kThreads / 32 / kWarpsAcross));

struct Sample {
  float s;                      // normalized offset of its camera
  float colour = 0, transmittance = 0, rest = 0;
  int channel;
};

// Colour of a splat at a sample: the polynomial of its channel, clamped at zero.
__device__ inline float colour_at(const float* colour, int order, const Sample& sample) {
  float c = __ldg(colour + order * kColourStride + sample.channel);
  for (int p = order - 1; p >= 0; --p) c = fmaf(c, sample.s, __ldg(colour + p * kColourStride + sample.channel));
  return fmaxf(c, 0.f);
}

template <class Out>
__device__ inline Out stored(float c) {
  if constexpr (sizeof(Out) == 1) return Out(fminf(fmaxf(c, 0.f), 1.f) * 255.f + 0.5f);
  return c;
}

template <class Out>
__global__ void __launch_bounds__(kThreads)
    composite_lens_kernel(Splats<float> splats, Image image, const int64_t* ranges, Pairs pairs, Lens lens,
                          float s_start, float s_step, const float* background, Out* out) {
  __shared__ Splat<float> staged[kBatch];
  __shared__ uint32_t ids[kBatch];
  const int warp = threadIdx.x / 32, lane = threadIdx.x % 32;
  const int64_t across = (image.width_px + kLensTile.width_px - 1) / kLensTile.width_px;
  const int64_t x0 = blockIdx.x % across * kLensTile.width_px, y0 = blockIdx.x / across * kLensTile.height_px;
  const int left = warp % kWarpsAcross * kWarpWidth, top = warp / kWarpsAcross * kWarpHeight;
  const int column = left + lane % kWarpWidth, row = top + lane / kWarpWidth;
  const float x = column + 0.5f;

  // The sub-pixels of this lane
  Sample samples[kRows][3];
  for (int r = 0; r < kRows; ++r)
    for (int k = 0; k < 3; ++k) {
      const int64_t i = y0 + row + 2 * r, j = x0 + column;
      Sample& sample = samples[r][k];
      sample.channel = lens.bgr ? 2 - k : k;
      sample.transmittance = i < image.height_px && j < image.width_px ? 1.f : 0.f;
      const uint64_t phase = lens.phase_at(i, 3 * j + k);
      sample.s = fmaf(s_step, float(camera_coordinate(lens, phase)), s_start);
    }

  for (int64_t begin = ranges[2 * int64_t(blockIdx.x)], end = ranges[2 * int64_t(blockIdx.x) + 1]; begin < end;
       begin += kBatch) {
    bool open = false;
    for (auto& pixel : samples)
      for (auto& sample : pixel) open |= sample.transmittance > 0;
    if (__syncthreads_and(!open)) break;
    const int count = int(min(int64_t(kBatch), end - begin));
    for (int k = threadIdx.x; k < count; k += kThreads) {
      const uint32_t id = pairs.slot_splats[pairs.sorted_slots[begin + k]];
      Splat<float> s = splats.splats[id];
      s.u0 -= float(x0), s.v0 -= float(y0);
      staged[k] = s, ids[k] = id;
    }
    __syncthreads();
    if (!__any_sync(~0u, open)) continue;

    // 32 candidates at a time: each lane holds one against the warp's pixels, then all evaluate those that may touch
    for (int first = 0; first < count; first += 32) {
      float low, high;
      const bool hit = first + lane < count &&
                       columns_of(staged[first + lane], top + 0.5f, top + kWarpHeight - 0.5f, 0.f, low, high) &&
                       high >= left + 0.5f && low <= left + kWarpWidth - 0.5f;
      for (unsigned todo = __ballot_sync(~0u, hit); todo; todo &= todo - 1) {
        const int k = first + __ffs(todo) - 1;
        const Splat<float>& s = staged[k];
        const uint32_t id = ids[k];
        const int order = splats.orders[id];
        const float* colour = splats.colours + int64_t(id) * (splats.colour_order + 1) * kColourStride;
#pragma unroll
        for (int r = 0; r < kRows; ++r) {
          const float dy = row + 2 * r + 0.5f - s.v0, A = s.log2_opacity - s.tau * dy * dy;
          const float M0 = x - fmaf(s.c0, dy, s.u0), M1 = fmaf(s.c1, dy, s.du);
#pragma unroll
          for (int c = 0; c < 3; ++c) {
            Sample& sample = samples[r][c];
            const float dx = fmaf(-sample.s, M1, M0), S = fmaf(fmaf(sample.s, s.S2, s.S1), sample.s, s.S0);
            const float alpha = alpha_of(A - __fdividef(dx * dx, S));
            if (alpha == 0) continue;
            float weight;
            over(alpha, sample.transmittance, sample.rest, weight);
            sample.colour = fmaf(weight, colour_at(colour, order, sample), sample.colour);
          }
        }
      }
    }
  }

  for (int r = 0; r < kRows; ++r)
    for (int k = 0; k < 3; ++k) {
      const int64_t i = y0 + row + 2 * r, j = x0 + column;
      if (i >= image.height_px || j >= image.width_px) continue;
      const Sample& sample = samples[r][k];
      const float c = sample.colour + remaining(sample.transmittance, sample.rest) * background[sample.channel];
      out[3 * (i * image.width_px + j) + sample.channel] = stored<Out>(c);
    }
}

}  // namespace

void composite_lens(const Splats<float>& splats, const Image& image, const int64_t* ranges, const Pairs& pairs,
                    const Lens& lens, const float* background, float* out, uint8_t* out8, Stream stream) {
  const int64_t tiles = tile_count(image.tile, image.width_px, image.height_px);
  const double reach = lens.reach();
  const float start = reach > 0 ? float(lens.offset_start / reach) : 0;
  const float step = reach > 0 ? float(lens.offset_step / reach) : 0;
  if (out8)
    composite_lens_kernel<uint8_t><<<unsigned(tiles), kThreads, 0, cudaStream_t(stream)>>>(
        splats, image, ranges, pairs, lens, start, step, background, out8);
  else
    composite_lens_kernel<float><<<unsigned(tiles), kThreads, 0, cudaStream_t(stream)>>>(
        splats, image, ranges, pairs, lens, start, step, background, out);
  check_launch("composite_lens");
}

}  // namespace lfgs::cuda
