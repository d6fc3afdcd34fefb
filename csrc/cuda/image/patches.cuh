// The tiles of ordinary images on the device. A block has a tile of 16 x 16 pixels, a warp a patch of 8 x 4 of them, a
// thread a pixel. Composites go over the splats nearest first, and a warp passes over the splats that cannot touch its
// patch.
#pragma once

#include <cstdint>

#include "cuda/common/gaussian_io.cuh"
#include "cuda/stages/stages.h"
#include "math/footprint.h"

namespace lfgs::cuda {

constexpr int kSide = 16, kThreads = kSide * kSide, kWarps = kThreads / 32;
constexpr int kPatchWidth = 8, kPatchHeight = 4, kPatchesAcross = kSide / kPatchWidth;
constexpr unsigned kAll = ~0u;     // lanes
constexpr int kIntersections = 8;  // of a backward pass at once: with the four rows of a patch, a sum for every lane
static_assert(kIntersections * kPatchHeight == 32);
static_assert(kImageTile.width_px == kSide && kImageTile.height_px == kSide && kPatchWidth * kPatchHeight == 32);

// A splat as the pixels of a tile read it.
struct Outline {
  float4 place;      // u0 and v0, from the tile's corner; c0, tau
  float2 size;       // log2 opacity, 1 / S
  uint32_t patches;  // bit w: it may touch the patch of warp w

  // log2 of opacity * weight at a pixel.
  __device__ float power(float x, float y) const {
    const float dy = y - place.y, dx = x - place.x - place.z * dy;
    return size.x - place.w * dy * dy - dx * dx * size.y;
  }
};

// The tile of this block, the patch of this warp and the pixel of this thread.
struct Pixel {
  int warp, lane;
  int64_t image, x0, y0, index;
  float x, y;  // centre, from the tile's corner
  bool inside;

  __device__ explicit Pixel(const Image& all) : warp(threadIdx.x / 32), lane(threadIdx.x % 32) {
    const int64_t tiles = tile_count(all.tile, all.width_px, all.height_px), place = blockIdx.x % tiles;
    const int64_t across = (all.width_px + kSide - 1) / kSide;
    const int column = warp % kPatchesAcross * kPatchWidth + lane % kPatchWidth;
    const int row = warp / kPatchesAcross * kPatchHeight + lane / kPatchWidth;
    image = blockIdx.x / tiles, x0 = place % across * kSide, y0 = place / across * kSide;
    x = column + 0.5f, y = row + 0.5f;
    inside = x0 + column < all.width_px && y0 + row < all.height_px;
    index = (image * all.height_px + y0 + row) * all.width_px + x0 + column;
  }
};

// The patches of a tile that a splat may touch, a bit for each warp. The splat's centre counts from the tile's corner.
__device__ inline uint32_t touched_patches(const Splat<float>& s) {
  uint32_t patches = 0;
#pragma unroll
  for (int down = 0; down < kSide / kPatchHeight; ++down) {
    const float top = down * kPatchHeight + 0.5f;
    float low, high;
    if (!footprint_columns(s, top, top + (kPatchHeight - 1), 0.f, low, high)) continue;
#pragma unroll
    for (int across = 0; across < kPatchesAcross; ++across) {
      const float left = across * kPatchWidth + 0.5f;
      if (high >= left && low <= left + (kPatchWidth - 1)) patches |= 1u << (down * kPatchesAcross + across);
    }
  }
  return patches;
}

// Read a splat for the tile of this block.
__device__ inline Outline outline_of(Splat<float> s, const Pixel& pixel) {
  s.u0 -= float(pixel.x0), s.v0 -= float(pixel.y0);
  return {make_float4(s.u0, s.v0, s.c0, s.tau), make_float2(s.log2_opacity, 1 / s.S0), touched_patches(s)};
}

// Which of 32 staged splats, from `first` on, may touch the patch of this warp. The first of them is the highest bit,
// so that it is found in one step.
template <class Staged>
__device__ unsigned candidates(const Staged* staged, int first, int count, const Pixel& pixel) {
  const int own = first + 31 - pixel.lane;
  return __ballot_sync(kAll, own < count && staged[own].patches >> pixel.warp & 1);
}

// Take the first splat out of such a set, and return its number there.
__device__ inline int take_first(unsigned& set) {
  const int first = __clz(int(set));
  set ^= 0x80000000u >> first;
  return first;
}

// The sums over a patch of one splat's footprint, from moments of the effects of a row's pixels (FootprintSum). The
// effects are the gradients of the exponent, divided by ln 2; moments are of the distance from the middle of the row,
// which is at (dx, dy) from the splat's.
template <int kSums>
__device__ void footprint_sums(const Outline& s, float (&moments)[3], float dx, float dy, float (&sums)[kSums]) {
  for (float& moment : moments) moment *= float(kLn2);
  const float g = moments[0], gx = -2 * s.size.y * (moments[1] + dx * g);
  sums[kPowerSum] = g, sums[kPowerDySum] = g * dy, sums[kPowerDy2Sum] = g * dy * dy;
  sums[kXSum] = gx, sums[kXDySum] = gx * dy;
  sums[kSSum] = s.size.y * s.size.y * (moments[2] + dx * (2 * moments[1] + dx * g));
}

}  // namespace lfgs::cuda
