// Stage composite for ordinary images on the device, and its backward pass. The forward pass reads the splats and the
// sorted intersections, and writes colour, alpha and depth. The backward pass reads these images and their gradients,
// and writes the sums of every intersection and of the background.
#include "cuda/common/blend.cuh"
#include "cuda/common/launch.h"
#include "cuda/common/gaussian_io.cuh"
#include "cuda/image/patches.cuh"
#include "cuda/stages/stages.h"

namespace lfgs::cuda {
namespace {

// A splat with the numbers that an image blends.
struct Staged : Outline {
  float4 colour;  // r, g, b, depth
};

// Read a splat for the tile of this block.
__device__ Staged stage(const Splats<float>& splats, uint32_t id, const Pixel& pixel) {
  const Splat<float> s = read_splat(splats.splats + id);
  const float4 c = __ldg(reinterpret_cast<const float4*>(splats.colours) + id);
  return {outline_of(s, pixel), make_float4(c.x, c.y, c.z, s.depth)};
}

// Draw a tile: the block stages its splats in batches, and each thread blends them into its pixel.
__global__ void __launch_bounds__(kThreads)
    composite_images_kernel(Splats<float> splats, Image image, const int64_t* ranges, Intersections intersections,
                            const float* background, Images<float> out) {
  __shared__ Staged staged[kThreads];
  const Pixel pixel(image);
  float transmittance = pixel.inside ? 1.f : 0.f, rest = 0, r = 0, g = 0, b = 0, depth = 0;

  const int64_t end = ranges[2 * int64_t(blockIdx.x) + 1];
  for (int64_t begin = ranges[2 * int64_t(blockIdx.x)]; begin < end; begin += kThreads) {
    // End the list where no pixel takes light any more; else stage a splat a thread
    if (__syncthreads_and(transmittance == 0)) break;
    const int count = int(min(int64_t(kThreads), end - begin));
    if (int(threadIdx.x) < count)
      staged[threadIdx.x] = stage(splats, sorted_splat(intersections, begin + threadIdx.x), pixel);
    __syncthreads();

    // Take 32 at a time: each lane looks at one, then all lanes blend those that may touch the patch
    for (int first = 0; first < count && __any_sync(kAll, transmittance > 0); first += 32) {
      for (unsigned todo = candidates(staged, first, count, pixel); todo;) {
        const Staged& s = staged[first + take_first(todo)];
        float weight;
        over(to_alpha(s.power(pixel.x, pixel.y)), transmittance, rest, weight);
        r += weight * s.colour.x, g += weight * s.colour.y, b += weight * s.colour.z, depth += weight * s.colour.w;
      }
    }
  }

  // Add the background by the light that is left, and store
  if (!pixel.inside) return;
  const float left = remaining(transmittance, rest);
  const float* behind = background + 3 * pixel.image;
  out.image[3 * pixel.index] = r + left * behind[0];
  out.image[3 * pixel.index + 1] = g + left * behind[1];
  out.image[3 * pixel.index + 2] = b + left * behind[2];
  out.alpha[pixel.index] = 1 - left;
  out.depth[pixel.index] = depth;
}

// --- The backward pass. A warp alternates between two steps. First every lane evaluates kIntersections splats that may
// touch the patch at its pixel. Then the lanes share the sums over the pixels. Within either step no lane waits for
// another.

template <int kSums>
constexpr int kBatchOf = kSums == kImageSums ? 64 : 60;  // splats staged at a time: 48 KiB hold no more with all sums

// A sample in the backward pass. `behind` is the part of the loss of everything behind the current splat. Before the
// first splat it follows from the sample's gradients and its image.
struct Sample {
  float4 gradient;  // of r, g, b, depth
  float transmittance, behind;

  // Advance the sample past one splat. Return the gradient of the exponent at this sample, divided by ln 2 (x), and the
  // weight of the splat (y). See over_backward() for the formula.
  __device__ float2 pass(const Staged& s, float x, float y) {
    const float power = s.power(x, y), before = transmittance;
    float alpha = to_alpha(power);
    const float weight = over_again(alpha, transmittance);
    const float v =
        gradient.x * s.colour.x + gradient.y * s.colour.y + gradient.z * s.colour.z + gradient.w * s.colour.w;
    behind -= weight * v;
    const float g_alpha = over_backward<true>(alpha, before, v, behind);
    return make_float2(power < float(kLog2MaxAlpha) ? g_alpha * alpha : 0.f, weight);
  }
};

// The sample of this thread before the first splat; `rest` receives the light that it left for the background.
__device__ Sample sample_at(const Pixel& pixel, Images<const float> images, Images<const float> gradients,
                            float& rest) {
  rest = 0;
  if (!pixel.inside) return {make_float4(0, 0, 0, 0), 0, 0};
  const float *rgb = images.image + 3 * pixel.index, *g_rgb = gradients.image + 3 * pixel.index;
  const float4 g = make_float4(g_rgb[0], g_rgb[1], g_rgb[2], gradients.depth ? gradients.depth[pixel.index] : 0.f);
  rest = 1 - images.alpha[pixel.index];
  float all = g.x * rgb[0] + g.y * rgb[1] + g.z * rgb[2] + g.w * images.depth[pixel.index];
  if (gradients.alpha) all -= gradients.alpha[pixel.index] * rest;
  return {g, 1, all};
}

// The sum over a row of what its pixels' gradients of a splat's place are, each taken absolutely. The middle of the row
// is at (dx, dy) from the splat's.
__device__ float2 absolute_sums(const Staged& s, const float2* effects, float dx, float dy) {
  float2 sums = make_float2(0, 0);
#pragma unroll
  for (int i = 0; i < kPatchWidth; ++i) {
    const float g = 2 * float(kLn2) * effects[i].x, across = dx + (i - 0.5f * (kPatchWidth - 1));
    const float u = g * s.size.y * across;
    sums.x += fabsf(u), sums.y += fabsf(g * s.place.w * dy - s.place.z * u);
  }
  return sums;
}

// The sums over a patch for one splat. A lane has one row of the patch: effects and gradients are those of the row's
// pixels, and (x, y) is its middle. The rows of one splat are with lanes kHits apart, which then join their sums.
template <int kSums>
__device__ void sum_over_patch(const Staged& s, const float2* effects, const float4* gradients, float x, float y,
                               float (&sums)[kSums]) {
  // Over the pixels of the row; moments are of the distance from its middle
  float moments[3] = {}, depth = 0, colour[3] = {};
#pragma unroll
  for (int i = 0; i < kPatchWidth; ++i) {
    const float2 effect = effects[i];
    const float4 gradient = gradients[i];
    const float across = i - 0.5f * (kPatchWidth - 1);
    moments[0] += effect.x, moments[1] += across * effect.x, moments[2] += across * across * effect.x;
    depth += effect.y * gradient.w, colour[0] += effect.y * gradient.x;
    colour[1] += effect.y * gradient.y, colour[2] += effect.y * gradient.z;
  }

  // The numbers of an intersection follow from these
  const float dy = y - s.place.y, dx = x - s.place.x - s.place.z * dy;
  footprint_sums(s, moments, dx, dy, sums);
  sums[kDepthSum] = depth;
  for (int c = 0; c < 3; ++c) sums[kColourSum + c] = colour[c];
  if constexpr (kSums == kAbsoluteImageSums) {
    const float2 absolute = absolute_sums(s, effects, dx, dy);
    sums[kAbsoluteSum] = absolute.x, sums[kAbsoluteSum + 1] = absolute.y;
  }

  // Join the rows
#pragma unroll
  for (int f = 0; f < kSums; ++f)
    for (int step = kIntersections; step < 32; step *= 2) sums[f] += __shfl_xor_sync(kAll, sums[f], step);
}

// Write the gradient of the background, summed over the tile: over each warp, then over the warps.
__device__ void background_backward(const Pixel& pixel, const Sample& sample, float rest, float (&partial)[kWarps][3],
                                    float* tile_background) {
  const float behind[3] = {warp_sum(sample.gradient.x * rest), warp_sum(sample.gradient.y * rest),
                           warp_sum(sample.gradient.z * rest)};
  if (pixel.lane == 0)
    for (int c = 0; c < 3; ++c) partial[pixel.warp][c] = behind[c];
  __syncthreads();
  if (threadIdx.x >= 3) return;
  float sum = 0;
  for (int w = 0; w < kWarps; ++w) sum += partial[w][threadIdx.x];
  tile_background[3 * int64_t(blockIdx.x) + threadIdx.x] = sum;
}

// Write the sums of every intersection of a tile, a block each. The sums run within each warp, then over the warps that
// the splat touches, always in the same order. So the bits are always the same.
template <int kSums>
__global__ void __launch_bounds__(kThreads, 4)
    composite_images_backward_kernel(Splats<float> splats, Image image, const int64_t* ranges,
                                     Intersections intersections, Images<const float> images,
                                     Images<const float> gradients, float* intersection_gradients,
                                     float* tile_background) {
  constexpr int kBatch = kBatchOf<kSums>;
  __shared__ Staged staged[kBatch];
  __shared__ uint32_t indices[kBatch], summed[kBatch];  // summed, bit w: warp w has sums of this splat
  __shared__ float2
      effects[kWarps][kIntersections][32 + 1];  // odd rows, so that no two lanes of a half warp meet in a bank
  __shared__ float4 pixel_gradients[kWarps][32];
  __shared__ float partial[kWarps][kBatch][kSums], partial_background[kWarps][3];
  const Pixel pixel(image);
  float rest;
  Sample sample = sample_at(pixel, images, gradients, rest);
  pixel_gradients[pixel.warp][pixel.lane] = sample.gradient;
  background_backward(pixel, sample, rest, partial_background, tile_background);

  // What this lane sums up: which intersection and which row of the patch; and the middle of the row
  const int own = pixel.lane % kIntersections, row = pixel.lane / kIntersections;
  const float row_x = (pixel.warp % kPatchesAcross + 0.5f) * kPatchWidth;
  const float row_y = pixel.warp / kPatchesAcross * kPatchHeight + row + 0.5f;

  const int64_t end = ranges[2 * int64_t(blockIdx.x) + 1];
  for (int64_t begin = ranges[2 * int64_t(blockIdx.x)]; begin < end; begin += kBatch) {
    // Stage splats, and where their sums will go
    __syncthreads();
    const int count = int(min(int64_t(kBatch), end - begin));
    if (int(threadIdx.x) < count) {
      indices[threadIdx.x] = intersections.sorted_indices[begin + threadIdx.x], summed[threadIdx.x] = 0;
      staged[threadIdx.x] = stage(splats, sorted_splat(intersections, begin + threadIdx.x), pixel);
    }
    __syncthreads();

    // Take up to kHits of those that may touch the patch, then sum over it
    for (int first = 0; first < count && __any_sync(kAll, sample.transmittance > 0); first += 32) {
      unsigned todo = candidates(staged, first, count, pixel);
      if (todo << pixel.lane >> 31) atomicOr(&summed[first + pixel.lane], 1u << pixel.warp);
      while (todo) {
        int filled = 0, splat = first;  // splat: the one that this lane sums up
        do {
          const int k = first + take_first(todo);
          effects[pixel.warp][filled][pixel.lane] = sample.pass(staged[k], pixel.x, pixel.y);
          splat = own == filled ? k : splat;
        } while (++filled < kIntersections && todo);
        __syncwarp();
        float sums[kSums];
        sum_over_patch(staged[splat], &effects[pixel.warp][own][row * kPatchWidth],
                       &pixel_gradients[pixel.warp][row * kPatchWidth], row_x, row_y, sums);
        if (row == 0 && own < filled)
          for (int f = 0; f < kSums; ++f) partial[pixel.warp][splat][f] = sums[f];
        __syncwarp();
      }
    }
    __syncthreads();

    // Sums over the warps, a number a thread
    for (int i = threadIdx.x; i < count * kSums; i += kThreads) {
      const int k = i / kSums, f = i % kSums;
      float sum = 0;
      for (uint32_t warps = summed[k]; warps; warps &= warps - 1) sum += partial[__ffs(int(warps)) - 1][k][f];
      intersection_gradients[int64_t(indices[k]) * kSums + f] = sum;
    }
  }
}

}  // namespace

void composite_images(const Splats<float>& splats, const Image& image, const int64_t* ranges,
                      const Intersections& intersections, const float* background, Images<float> out, Stream stream) {
  const int64_t tiles = image.count * tile_count(image.tile, image.width_px, image.height_px);
  if (tiles == 0) return;
  composite_images_kernel<<<unsigned(tiles), kThreads, 0, cudaStream_t(stream)>>>(splats, image, ranges, intersections,
                                                                                  background, out);
  check_launch("composite_images");
}

void composite_images_backward(const Splats<float>& splats, const Image& image, const int64_t* ranges,
                               const Intersections& intersections, Images<const float> images,
                               Images<const float> gradients, bool absolute, float* intersection_gradients,
                               float* tile_background, Stream stream) {
  const int64_t tiles = image.count * tile_count(image.tile, image.width_px, image.height_px);
  if (tiles == 0) return;
  const auto kernel =
      absolute ? composite_images_backward_kernel<kAbsoluteImageSums> : composite_images_backward_kernel<kImageSums>;
  kernel<<<unsigned(tiles), kThreads, 0, cudaStream_t(stream)>>>(splats, image, ranges, intersections, images,
                                                                 gradients, intersection_gradients, tile_background);
  check_launch("composite_images_backward");
}

}  // namespace lfgs::cuda
