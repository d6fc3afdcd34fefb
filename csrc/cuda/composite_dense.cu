// Stage composite for ordinary images on the device: a block per tile of 16 x 16 pixels, a thread per pixel.
#include "cuda/blend.cuh"
#include "cuda/check.h"
#include "cuda/stages.h"

namespace lfgs::cuda {
namespace {

constexpr int kSide = 16, kThreads = kSide * kSide;
static_assert(kDenseTile.width_px == kSide && kDenseTile.height_px == kSide);

// A splat as the pixels of a tile read it.
struct Staged {
  float4 place;   // u0, v0 from the tile's corner, c0, tau
  float4 colour;  // r, g, b, depth
  float2 size;    // log2 opacity, 1 / S
};

__global__ void __launch_bounds__(kThreads)
    composite_dense_kernel(Splats<float> splats, Image image, const int64_t* ranges, const uint32_t* tile_splats,
                           const float* background, DenseImages<float> out) {
  __shared__ Staged staged[kThreads];
  const int64_t tiles = tile_count(image.tile, image.width_px, image.height_px);
  const int64_t tile = blockIdx.x, number = tile / tiles, place = tile % tiles;
  const int64_t across = (image.width_px + kSide - 1) / kSide;
  const int64_t x0 = place % across * kSide, y0 = place / across * kSide;
  const int column = threadIdx.x % kSide, row = threadIdx.x / kSide;
  const bool inside = x0 + column < image.width_px && y0 + row < image.height_px;
  const float x = column + 0.5f, y = row + 0.5f;
  float transmittance = inside ? 1.f : 0.f, rest = 0, r = 0, g = 0, b = 0, depth = 0;

  for (int64_t begin = ranges[2 * tile], end = ranges[2 * tile + 1]; begin < end; begin += kThreads) {
    if (__syncthreads_and(transmittance == 0)) break;
    if (begin + threadIdx.x < end) {
      const uint32_t id = tile_splats[begin + threadIdx.x];
      const Splat<float> s = splats.splats[id];
      const float4 c = reinterpret_cast<const float4*>(splats.colours)[id];
      staged[threadIdx.x] = {make_float4(s.u0 - float(x0), s.v0 - float(y0), s.c0, s.tau),
                             make_float4(c.x, c.y, c.z, s.depth), make_float2(s.log2_opacity, 1 / s.S0)};
    }
    __syncthreads();
    const int count = int(min(int64_t(kThreads), end - begin));
    for (int k = 0; k < count && transmittance > 0; ++k) {
      const Staged s = staged[k];
      const float dy = y - s.place.y, dx = x - s.place.x - s.place.z * dy;
      const float alpha = alpha_of(s.size.x - s.place.w * dy * dy - dx * dx * s.size.y);
      if (alpha == 0) continue;
      float weight;
      over(alpha, transmittance, rest, weight);
      r += weight * s.colour.x, g += weight * s.colour.y, b += weight * s.colour.z, depth += weight * s.colour.w;
    }
  }
  if (!inside) return;
  const int64_t pixel = (number * image.height_px + y0 + row) * image.width_px + x0 + column;
  const float left = remaining(transmittance, rest);
  out.image[3 * pixel] = r + left * background[3 * number];
  out.image[3 * pixel + 1] = g + left * background[3 * number + 1];
  out.image[3 * pixel + 2] = b + left * background[3 * number + 2];
  out.alpha[pixel] = 1 - left;
  out.depth[pixel] = depth;
}

}  // namespace

void composite_dense(const Splats<float>& splats, const Image& image, const int64_t* ranges,
                     const uint32_t* tile_splats, const float* background, DenseImages<float> out, Stream stream) {
  const int64_t tiles = image.count * tile_count(image.tile, image.width_px, image.height_px);
  if (tiles == 0) return;
  composite_dense_kernel<<<unsigned(tiles), kThreads, 0, cudaStream_t(stream)>>>(splats, image, ranges, tile_splats,
                                                                                background, out);
  check_launch("composite_dense");
}

}  // namespace lfgs::cuda
