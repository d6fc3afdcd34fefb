// Stage composite on the device for sub-pixels sorted by view, where each view is an ordinary camera. It reads the
// splats, the sorted pairs of every (view, tile) and the lists of sub-pixels, and writes those sub-pixels of the image.
//
// A block has the sub-pixels of one view in one tile, a thread a sub-pixel at a time. The sub-pixels of a warp lie
// close together, since the lists run along the columns; so a warp looks only at the splats that may touch the box
// around them.
#include "cuda/common/blend.cuh"
#include "cuda/common/check.h"
#include "cuda/stages/stages.h"

namespace lfgs::cuda {
namespace {

constexpr int kThreads = 256;
static_assert(kThreads % kSubpixelBlock == 0 && kSubpixelBlock == 32);

// A splat as the sub-pixels of a tile read it.
struct Staged {
  float4 place;  // u0 and v0, from the tile's corner; c0, tau
  float2 size;   // log2 opacity, 1 / S

  // log2 of opacity * weight at a sub-pixel.
  __device__ float power(float x, float y) const {
    const float dy = y - place.y, dx = x - place.x - place.z * dy;
    return size.x - place.w * dy * dy - dx * dx * size.y;
  }
};

// The box around the sub-pixels of a warp: middle and half size.
struct Box {
  float x, y, half_x, half_y;

  // Whether the alpha of a splat may be above the opacity cut somewhere in the box; it errs on the wide side.
  __device__ bool meets(const Staged& s) const {
    const float middle = y - s.place.y, nearest = fmaxf(fabsf(middle) - half_y, 0.f);
    const float exponent = s.size.x - s.place.w * nearest * nearest + float(1e-3 - kLog2MinAlpha);
    const float distance =
        fmaxf(fabsf(x - s.place.x - s.place.z * middle) - (half_x + fabsf(s.place.z) * half_y + 0.01f), 0.f);
    return exponent >= 0 && distance * distance * s.size.y <= exponent;
  }
};

// The sub-pixel of this thread; `some` is false on threads that have none.
struct Sample {
  float x = 0, y = 0;  // centre, from the tile's corner
  int channel = 0;
  int64_t place = 0;  // in the image
  bool some = false;

  __device__ Sample(const SubpixelTile& tile, uint16_t code, int64_t x0, int64_t y0, int64_t width_px) {
    if (code == kNoSubpixel) return;
    const Subpixel s = decode_subpixel(tile, code);
    x = s.column + 0.5f, y = s.row + 0.5f, channel = s.channel, some = true;
    place = ((y0 + s.row) * width_px + x0 + s.column) * 3 + s.channel;
  }

  // The box around the samples of the warp; where there are none, it meets no splat.
  __device__ Box box() const {
    const float far = 1e9f;
    float left = some ? x : far, right = some ? x : -far, top = some ? y : far, bottom = some ? y : -far;
    for (int step = 16; step > 0; step /= 2) {
      left = fminf(left, __shfl_xor_sync(~0u, left, step)), right = fmaxf(right, __shfl_xor_sync(~0u, right, step));
      top = fminf(top, __shfl_xor_sync(~0u, top, step)), bottom = fmaxf(bottom, __shfl_xor_sync(~0u, bottom, step));
    }
    return {(left + right) / 2, (top + bottom) / 2, (right - left) / 2, (bottom - top) / 2};
  }
};

// A splat for the tile whose corner is at (x0, y0).
__device__ Staged stage(const Splat<float>& s, float x0, float y0) {
  return {make_float4(s.u0 - x0, s.v0 - y0, s.c0, s.tau), make_float2(s.log2_opacity, 1 / s.S0)};
}

// Draws the sub-pixels of one (view, tile), a block each; blocks start in the order that the caller gives. For every
// kThreads sub-pixels the block stages the tile's splats in batches, and each thread blends them into its own.
__global__ void __launch_bounds__(kThreads)
    composite_sorted_kernel(Splats<float> splats, Image image, const int64_t* ranges, Pairs pairs, SubpixelLists lists,
                            const int64_t* order, const float* background, float* out, uint8_t* out8) {
  __shared__ Staged staged[kThreads];
  __shared__ alignas(16) float colours[kThreads][kColourStride];
  const int64_t list = order[blockIdx.x];
  const int64_t across = lists.tile.across(image.width_px);
  const int64_t place = list % lists.tile.count(image.width_px, image.height_px);
  const int64_t x0 = place % across * lists.tile.width_px, y0 = place / across * lists.tile.height_px();
  const int64_t begin = ranges[2 * list], end = ranges[2 * list + 1], last = lists.starts[list + 1];
  const int lane = threadIdx.x % 32;

  // As many sub-pixels at a time as the block has threads. A tile has about so many of a view, so it takes one round on
  // average
  for (int64_t first = lists.starts[list]; first < last; first += kThreads) {
    const int64_t at = first + threadIdx.x;
    const Sample sample(lists.tile, at < last ? lists.codes[at] : kNoSubpixel, x0, y0, image.width_px);
    const Box box = sample.box();

    // Go over the list in batches, until no sample takes light any more
    float transmittance = sample.some ? 1.f : 0.f, rest = 0, value = 0;
    for (int64_t batch = begin; batch < end; batch += kThreads) {
      if (__syncthreads_and(transmittance == 0)) break;
      const int count = int(min(int64_t(kThreads), end - batch));
      if (int(threadIdx.x) < count) {
        const uint32_t id = splat_of(pairs, batch + threadIdx.x);
        staged[threadIdx.x] = stage(splats.splats[id], x0, y0);
        *reinterpret_cast<float4*>(colours[threadIdx.x]) = reinterpret_cast<const float4*>(splats.colours)[id];
      }
      __syncthreads();

      // Take 32 at a time: each lane looks at one, then all lanes blend those that may touch the box
      for (int group = 0; group < count && __any_sync(~0u, transmittance > 0); group += 32) {
        unsigned hits = __ballot_sync(~0u, group + lane < count && box.meets(staged[group + lane]));
        for (; hits; hits &= hits - 1) {
          const int hit = group + __ffs(hits) - 1;
          const float alpha = alpha_of(staged[hit].power(sample.x, sample.y)), colour = colours[hit][sample.channel];
          float weight;
          over(alpha, transmittance, rest, weight);
          value += weight * colour;
        }
      }
    }
    __syncthreads();  // before the splats are staged again for the next sub-pixels

    // Add what is left for the background, and store
    if (!sample.some) continue;
    const float colour = value + remaining(transmittance, rest) * background[sample.channel];
    if (out8)
      out8[sample.place] = stored(colour, out8);
    else
      out[sample.place] = stored(colour, out);
  }
}

}  // namespace

void composite_sorted(const Splats<float>& splats, const Image& image, const int64_t* ranges, const Pairs& pairs,
                      const SubpixelLists& lists, const int64_t* order, const float* background, float* out,
                      uint8_t* out8, Stream stream) {
  const int64_t count = image.count * lists.tile.count(image.width_px, image.height_px);
  if (count == 0) return;
  composite_sorted_kernel<<<unsigned(count), kThreads, 0, cudaStream_t(stream)>>>(splats, image, ranges, pairs, lists,
                                                                                  order, background, out, out8);
  check_launch("composite_sorted");
}

}  // namespace lfgs::cuda
