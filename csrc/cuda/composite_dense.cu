// Stage composite for ordinary images on the device, and its reverse: a block per tile of 16 x 16 pixels, a thread per
// pixel, splats nearest first in both directions.
#include "cuda/blend.cuh"
#include "cuda/check.h"
#include "cuda/stages.h"

namespace lfgs::cuda {
namespace {

constexpr int kSide = 16, kThreads = kSide * kSide, kWarps = kThreads / 32;
constexpr int kBackwardBatch = 32;
static_assert(kDenseTile.width_px == kSide && kDenseTile.height_px == kSide);

// A splat as the pixels of a tile read it.
struct Staged {
  float4 place;   // u0, v0 from the tile's corner, c0, tau
  float4 colour;  // r, g, b, depth
  float2 size;    // log2 opacity, 1 / S

  // log2 of opacity * weight at a pixel; also its place in the footprint.
  __device__ float power(float x, float y, float& dx, float& dy) const {
    dy = y - place.y, dx = x - place.x - place.z * dy;
    return size.x - place.w * dy * dy - dx * dx * size.y;
  }
};

// The tile of this block and the pixel of this thread.
struct Pixel {
  int64_t image, x0, y0, index;
  float x, y;  // centre, from the tile's corner
  bool inside;

  __device__ explicit Pixel(const Image& all) {
    const int64_t tiles = tile_count(all.tile, all.width_px, all.height_px), place = blockIdx.x % tiles;
    const int64_t across = (all.width_px + kSide - 1) / kSide;
    const int column = threadIdx.x % kSide, row = threadIdx.x / kSide;
    image = blockIdx.x / tiles, x0 = place % across * kSide, y0 = place / across * kSide;
    x = column + 0.5f, y = row + 0.5f;
    inside = x0 + column < all.width_px && y0 + row < all.height_px;
    index = (image * all.height_px + y0 + row) * all.width_px + x0 + column;
  }
};

__device__ Staged stage(const Splats<float>& splats, uint32_t id, const Pixel& pixel) {
  const Splat<float> s = splats.splats[id];
  const float4 c = reinterpret_cast<const float4*>(splats.colours)[id];
  return {make_float4(s.u0 - float(pixel.x0), s.v0 - float(pixel.y0), s.c0, s.tau),
          make_float4(c.x, c.y, c.z, s.depth), make_float2(s.log2_opacity, 1 / s.S0)};
}

__global__ void __launch_bounds__(kThreads)
    composite_dense_kernel(Splats<float> splats, Image image, const int64_t* ranges, Pairs pairs,
                           const float* background, DenseImages<float> out) {
  __shared__ Staged staged[kThreads];
  const Pixel pixel(image);
  float transmittance = pixel.inside ? 1.f : 0.f, rest = 0, r = 0, g = 0, b = 0, depth = 0;

  const int64_t end = ranges[2 * int64_t(blockIdx.x) + 1];
  for (int64_t begin = ranges[2 * int64_t(blockIdx.x)]; begin < end; begin += kThreads) {
    if (__syncthreads_and(transmittance == 0)) break;
    if (begin + threadIdx.x < end)
      staged[threadIdx.x] = stage(splats, pairs.slot_splats[pairs.sorted_slots[begin + threadIdx.x]], pixel);
    __syncthreads();
    const int count = int(min(int64_t(kThreads), end - begin));
    for (int k = 0; k < count && transmittance > 0; ++k) {
      float dx, dy, weight;
      const float alpha = alpha_of(staged[k].power(pixel.x, pixel.y, dx, dy));
      if (alpha == 0) continue;
      over(alpha, transmittance, rest, weight);
      const float4 c = staged[k].colour;
      r += weight * c.x, g += weight * c.y, b += weight * c.z, depth += weight * c.w;
    }
  }
  if (!pixel.inside) return;
  const float left = remaining(transmittance, rest);
  const float* behind = background + 3 * pixel.image;
  out.image[3 * pixel.index] = r + left * behind[0];
  out.image[3 * pixel.index + 1] = g + left * behind[1];
  out.image[3 * pixel.index + 2] = b + left * behind[2];
  out.alpha[pixel.index] = 1 - left;
  out.depth[pixel.index] = depth;
}

// See the CPU's BackwardSplat for the formula. Sums over a tile: first within each warp, then over the warps, always in
// the same order. Numbers of a slot: exponent * (1, dy, dy^2), dx * (1, dy), S, depth, r, g, b.
__global__ void __launch_bounds__(kThreads)
    composite_dense_backward_kernel(Splats<float> splats, Image image, const int64_t* ranges, Pairs pairs,
                                    DenseImages<const float> images, DenseImages<const float> gradients,
                                    float* slot_gradients, float* tile_background) {
  __shared__ Staged staged[kBackwardBatch];
  __shared__ uint32_t slots[kBackwardBatch];
  __shared__ float partial[kWarps][kBackwardBatch][kDenseSums];
  const Pixel pixel(image);
  const int warp = threadIdx.x / 32, lane = threadIdx.x % 32;
  float transmittance = pixel.inside ? 1.f : 0.f, prefix = 0, total = 0, gr = 0, gg = 0, gb = 0, gd = 0, rest = 0;
  if (pixel.inside) {
    rest = 1 - images.alpha[pixel.index];
    gr = gradients.image[3 * pixel.index], gg = gradients.image[3 * pixel.index + 1];
    gb = gradients.image[3 * pixel.index + 2], gd = gradients.depth[pixel.index];
    total = gr * images.image[3 * pixel.index] + gg * images.image[3 * pixel.index + 1] +
            gb * images.image[3 * pixel.index + 2] + gd * images.depth[pixel.index] -
            gradients.alpha[pixel.index] * rest;
  }
  const float g_behind[3] = {warp_sum(gr * rest), warp_sum(gg * rest), warp_sum(gb * rest)};
  if (lane == 0)
    for (int c = 0; c < 3; ++c) partial[warp][0][c] = g_behind[c];
  __syncthreads();
  if (threadIdx.x < 3) {
    float sum = 0;
    for (int w = 0; w < kWarps; ++w) sum += partial[w][0][threadIdx.x];
    tile_background[3 * int64_t(blockIdx.x) + threadIdx.x] = sum;
  }

  const int64_t end = ranges[2 * int64_t(blockIdx.x) + 1];
  for (int64_t begin = ranges[2 * int64_t(blockIdx.x)]; begin < end; begin += kBackwardBatch) {
    __syncthreads();
    const int count = int(min(int64_t(kBackwardBatch), end - begin));
    if (threadIdx.x < count) {
      slots[threadIdx.x] = pairs.sorted_slots[begin + threadIdx.x];
      staged[threadIdx.x] = stage(splats, pairs.slot_splats[slots[threadIdx.x]], pixel);
    }
    __syncthreads();
    for (int k = 0; k < count; ++k) {
      const Staged s = staged[k];
      float dx, dy;
      const float power = s.power(pixel.x, pixel.y, dx, dy);
      float alpha = transmittance > 0 ? alpha_of(power) : 0.f;
      const float after = transmittance - alpha * transmittance;
      if (alpha > 0 && after < float(kMinTransmittance)) alpha = transmittance = 0;
      float* out = partial[warp][k];
      if (!__any_sync(~0u, alpha > 0)) {
        if (lane < kDenseSums) out[lane] = 0;
        continue;
      }
      const float weight = alpha * transmittance;
      const float v = gr * s.colour.x + gg * s.colour.y + gb * s.colour.z + gd * s.colour.w;
      prefix += weight * v;
      const float g_alpha = transmittance * v - (total - prefix) / (1 - alpha);
      const float g = alpha > 0 && power < float(kLog2MaxAlpha) ? g_alpha * alpha * float(kLn2) : 0.f;
      if (alpha > 0) transmittance = after;
      const float e = dx * s.size.y, gx = -2 * g * e;
      const float sums[kDenseSums] = {g,     g * dy, g * dy * dy, gx,          gx * dy,
                                      g * e * e, weight * gd, weight * gr, weight * gg, weight * gb};
#pragma unroll
      for (int f = 0; f < kDenseSums; ++f) {
        const float sum = warp_sum(sums[f]);
        if (lane == 0) out[f] = sum;
      }
    }
    __syncthreads();
    for (int i = threadIdx.x; i < count * kDenseSums; i += kThreads) {
      float sum = 0;
      for (int w = 0; w < kWarps; ++w) sum += partial[w][i / kDenseSums][i % kDenseSums];
      slot_gradients[int64_t(slots[i / kDenseSums]) * kDenseSums + i % kDenseSums] = sum;
    }
  }
}

}  // namespace

void composite_dense(const Splats<float>& splats, const Image& image, const int64_t* ranges, const Pairs& pairs,
                     const float* background, DenseImages<float> out, Stream stream) {
  const int64_t tiles = image.count * tile_count(image.tile, image.width_px, image.height_px);
  if (tiles == 0) return;
  composite_dense_kernel<<<unsigned(tiles), kThreads, 0, cudaStream_t(stream)>>>(splats, image, ranges, pairs,
                                                                                background, out);
  check_launch("composite_dense");
}

void composite_dense_backward(const Splats<float>& splats, const Image& image, const int64_t* ranges,
                              const Pairs& pairs, DenseImages<const float> images,
                              DenseImages<const float> gradients, float* slot_gradients, float* tile_background,
                              Stream stream) {
  const int64_t tiles = image.count * tile_count(image.tile, image.width_px, image.height_px);
  if (tiles == 0) return;
  composite_dense_backward_kernel<<<unsigned(tiles), kThreads, 0, cudaStream_t(stream)>>>(
      splats, image, ranges, pairs, images, gradients, slot_gradients, tile_background);
  check_launch("composite_dense_backward");
}

}  // namespace lfgs::cuda
