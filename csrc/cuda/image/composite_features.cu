// Composite of the features of Gaussians in ordinary images on the device, its backward pass, and the median depth.
// Weights are those of composite_images, bit for bit. Each pass blends a chunk of channels: every thread has those of
// its pixel in registers, and a block stages those of its splats.
//
// Floors, for D channels, P pixels, S pairs of a pixel and a splat of its warp's candidates, and I intersections:
//   forward   arithmetic (D + 20 ceil(D / 32)) S operations; bytes 4 D (P + I) + 48 ceil(D / 32) I
//   backward  arithmetic (2 D + 45 ceil(D / 16)) S operations; bytes 8 D P + 4 D I, and for the gradients of
//             intersections, which one kernel writes and the next reads, 8 (D + 6 ceil(D / 16)) I
// On an H100 (67e12 / 2 fused operations and 3.3e12 bytes a second) arithmetic is the higher floor in both directions
// where a splat has more than some 20 pixels in each tile that it touches.
#include "cuda/common/blend.cuh"
#include "cuda/common/launch.h"
#include "cuda/image/patches.cuh"
#include "cuda/stages/stages.h"

namespace lfgs::cuda {
namespace {

constexpr int kForwardChunk = 32;  // the backward pass has two numbers of each channel in registers, and half the chunk

// The channels of one pass: `used` of them from `first` on. Those up to the width of a chunk are zero.
struct Chunk {
  int64_t first;
  int used;
};

// Whether four numbers at a time can be read or written at multiples of `channels` from here.
__device__ bool by_fours(const float* numbers, int64_t channels) {
  return channels % 4 == 0 && reinterpret_cast<uintptr_t>(numbers) % 16 == 0;
}

// Stage the channels of `count` sorted splats from `begin` on; all threads of the block take part.
template <int kChannels>
__device__ void stage_channels(const Splats<float>& splats, const Intersections& intersections, int64_t begin,
                               int count, const Features<float>& features, const Chunk& chunk, int64_t image,
                               float4* values) {
  constexpr int kFours = kChannels / 4;
  const bool fours = by_fours(features.values, features.channels);
  for (int i = threadIdx.x; i < count * kFours; i += kThreads) {
    const int64_t splat = sorted_splat(intersections, begin + i / kFours) - image * splats.count;
    const int at = i % kFours * 4;
    const float* from = features.row(image, splats.count, splat) + chunk.first + at;
    float4 four;
    if (fours && at < chunk.used) {
      four = __ldg(reinterpret_cast<const float4*>(from));
    } else {
#pragma unroll
      for (int k = 0; k < 4; ++k) (&four.x)[k] = at + k < chunk.used ? from[k] : 0.f;
    }
    values[i] = four;
  }
}

// Draw one chunk of a tile: the block stages its splats in batches, and each thread blends them into its pixel.
template <int kChannels>
__global__ void __launch_bounds__(kThreads, kChannels > 16 ? 3 : 4)
    composite_features_kernel(Splats<float> splats, Image image, const int64_t* ranges, Intersections intersections,
                              Features<float> features, Chunk chunk, float* out) {
  constexpr int kFours = kChannels / 4;
  __shared__ Outline staged[kThreads];
  __shared__ float4 values[kThreads * kFours];
  const Pixel pixel(image);
  float transmittance = pixel.inside ? 1.f : 0.f, rest = 0;
  float4 sums[kFours];
#pragma unroll
  for (int c = 0; c < kFours; ++c) sums[c] = make_float4(0, 0, 0, 0);

  const int64_t end = ranges[2 * int64_t(blockIdx.x) + 1];
  for (int64_t begin = ranges[2 * int64_t(blockIdx.x)]; begin < end; begin += kThreads) {
    if (__syncthreads_and(transmittance == 0)) break;
    const int count = int(min(int64_t(kThreads), end - begin));
    if (int(threadIdx.x) < count)
      staged[threadIdx.x] =
          outline_of(read_splat(splats.splats + sorted_splat(intersections, begin + threadIdx.x)), pixel);
    stage_channels<kChannels>(splats, intersections, begin, count, features, chunk, pixel.image, values);
    __syncthreads();
    for (int first = 0; first < count && __any_sync(kAll, transmittance > 0); first += 32) {
      for (unsigned todo = candidates(staged, first, count, pixel); todo;) {
        const int k = first + take_first(todo);
        float weight;
        over(to_alpha(staged[k].power(pixel.x, pixel.y)), transmittance, rest, weight);
#pragma unroll
        for (int c = 0; c < kFours; ++c) {
          const float4 v = values[k * kFours + c];
          sums[c].x += weight * v.x, sums[c].y += weight * v.y, sums[c].z += weight * v.z, sums[c].w += weight * v.w;
        }
      }
    }
  }
  if (!pixel.inside) return;
  float* to = out + pixel.index * features.channels + chunk.first;
  const bool fours = by_fours(out, features.channels);
#pragma unroll
  for (int c = 0; c < kFours; ++c) {
    if (fours && 4 * c < chunk.used) {
      reinterpret_cast<float4*>(to)[c] = sums[c];
      continue;
    }
#pragma unroll
    for (int k = 0; k < 4; ++k)
      if (4 * c + k < chunk.used) to[4 * c + k] = (&sums[c].x)[k];
  }
}

// The depth of the last splat of each pixel that gives it light and that more than half of the light reaches.
__global__ void __launch_bounds__(kThreads)
    composite_median_depth_kernel(Splats<float> splats, Image image, const int64_t* ranges, Intersections intersections,
                                  float* out) {
  __shared__ Outline staged[kThreads];
  __shared__ float depths[kThreads];
  const Pixel pixel(image);
  float transmittance = pixel.inside ? 1.f : 0.f, rest = 0, depth = 0;
  const int64_t end = ranges[2 * int64_t(blockIdx.x) + 1];
  for (int64_t begin = ranges[2 * int64_t(blockIdx.x)]; begin < end; begin += kThreads) {
    if (__syncthreads_and(transmittance <= 0.5f)) break;
    const int count = int(min(int64_t(kThreads), end - begin));
    if (int(threadIdx.x) < count) {
      const Splat<float> s = read_splat(splats.splats + sorted_splat(intersections, begin + threadIdx.x));
      staged[threadIdx.x] = outline_of(s, pixel), depths[threadIdx.x] = s.depth;
    }
    __syncthreads();
    for (int first = 0; first < count && __any_sync(kAll, transmittance > 0.5f); first += 32) {
      for (unsigned todo = candidates(staged, first, count, pixel); todo;) {
        const int k = first + take_first(todo);
        const float before = transmittance;
        float weight;
        over(to_alpha(staged[k].power(pixel.x, pixel.y)), transmittance, rest, weight);
        if (before > 0.5f && weight > 0) depth = depths[k];
      }
    }
  }
  if (pixel.inside) out[pixel.index] = depth;
}

// --- The backward pass, as that of composite_images: a warp alternates between evaluating kIntersections splats, each
// lane at its pixel, and sums over the patch. In the latter a lane has a row of the patch for the sums of a footprint.
// For those of channels it has one channel, and a part of the patch's pixels.

// A sample and the gradients of its channels; see Sample of composite_images.cu.
template <int kChannels>
struct FeatureSample {
  float gradient[kChannels];
  float transmittance, behind;

  __device__ FeatureSample(const Pixel& pixel, const Features<float>& features, const Chunk& chunk)
      : transmittance(pixel.inside ? 1.f : 0.f), behind(0) {
    const int64_t at = pixel.index * features.channels + chunk.first;
#pragma unroll
    for (int c = 0; c < kChannels; ++c) {
      const bool there = pixel.inside && c < chunk.used;
      gradient[c] = there ? features.image_gradient[at + c] : 0.f;
      if (there) behind += gradient[c] * features.image[at + c];
    }
  }

  // Advance the sample past one splat; return the gradient of the exponent, divided by ln 2 (x), and the weight (y).
  __device__ float2 pass(const Outline& s, const float4* values, float x, float y) {
    const float power = s.power(x, y), before = transmittance;
    float alpha = to_alpha(power), v = 0;
    const float weight = over_again(alpha, transmittance);
#pragma unroll
    for (int c = 0; c < kChannels / 4; ++c) {
      const float4 four = values[c];
      v += gradient[4 * c] * four.x + gradient[4 * c + 1] * four.y + gradient[4 * c + 2] * four.z +
           gradient[4 * c + 3] * four.w;
    }
    behind -= weight * v;
    const float g_alpha = over_backward<true>(alpha, before, v, behind);
    return make_float2(power < float(kLog2MaxAlpha) ? g_alpha * alpha : 0.f, weight);
  }
};

// The gradients of one channel at the pixels of a lane: kChannels pixels from the lane's part of the patch.
template <int kChannels>
__device__ void load_channel(const Image& image, const Pixel& pixel, const Features<float>& features,
                             const Chunk& chunk, float (&gradients)[kChannels]) {
  const int channel = pixel.lane % kChannels, first = pixel.lane / kChannels * kChannels;
  const int64_t left = pixel.x0 + pixel.warp % kPatchesAcross * kPatchWidth;
  const int64_t top = pixel.y0 + pixel.warp / kPatchesAcross * kPatchHeight;
#pragma unroll
  for (int q = 0; q < kChannels; ++q) {
    const int64_t column = left + (first + q) % kPatchWidth, row = top + (first + q) / kPatchWidth;
    const bool there = column < image.width_px && row < image.height_px && channel < chunk.used;
    const int64_t at = (pixel.image * image.height_px + row) * image.width_px + column;
    gradients[q] = there ? features.image_gradient[at * features.channels + chunk.first + channel] : 0.f;
  }
}

// Write the sums of every intersection of a tile, a block each, in an order that is always the same.
template <int kChannels>
__global__ void __launch_bounds__(kThreads, 3)
    composite_features_backward_kernel(Splats<float> splats, Image image, const int64_t* ranges,
                                       Intersections intersections, Features<float> features, Chunk chunk,
                                       float* intersection_gradients) {
  constexpr int kSums = kImageFootprintSums + kChannels, kFours = kChannels / 4, kBatch = 32;
  __shared__ Outline staged[kBatch];
  __shared__ float4 values[kBatch * kFours];
  __shared__ uint32_t indices[kBatch], summed[kBatch];  // summed, bit w: warp w has sums of this splat
  __shared__ float effects[kWarps][kIntersections][32 + 1];
  __shared__ float4 weights[kWarps][kIntersections][8 + 1];  // four pixels each
  __shared__ float partial[kWarps][kBatch][kSums];
  const Pixel pixel(image);
  FeatureSample<kChannels> sample(pixel, features, chunk);
  float of_channel[kChannels];
  load_channel(image, pixel, features, chunk, of_channel);
  const int own = pixel.lane % kIntersections, row = pixel.lane / kIntersections;
  const float row_x = (pixel.warp % kPatchesAcross + 0.5f) * kPatchWidth;
  const float row_y = pixel.warp / kPatchesAcross * kPatchHeight + row + 0.5f;
  const int channel = pixel.lane % kChannels, part = pixel.lane / kChannels;

  const int64_t end = ranges[2 * int64_t(blockIdx.x) + 1];
  for (int64_t begin = ranges[2 * int64_t(blockIdx.x)]; begin < end; begin += kBatch) {
    __syncthreads();
    const int count = int(min(int64_t(kBatch), end - begin));
    if (int(threadIdx.x) < count) {
      indices[threadIdx.x] = intersections.sorted_indices[begin + threadIdx.x], summed[threadIdx.x] = 0;
      staged[threadIdx.x] =
          outline_of(read_splat(splats.splats + sorted_splat(intersections, begin + threadIdx.x)), pixel);
    }
    stage_channels<kChannels>(splats, intersections, begin, count, features, chunk, pixel.image, values);
    __syncthreads();

    if (__any_sync(kAll, sample.transmittance > 0)) {
      unsigned todo = candidates(staged, 0, count, pixel);
      if (todo << pixel.lane >> 31) atomicOr(&summed[pixel.lane], 1u << pixel.warp);
      while (todo) {
        int filled = 0, splat = 0;  // splat: the one whose footprint this lane sums up
        do {
          const int k = take_first(todo);
          const float2 effect = sample.pass(staged[k], values + k * kFours, pixel.x, pixel.y);
          effects[pixel.warp][filled][pixel.lane] = effect.x;
          reinterpret_cast<float*>(weights[pixel.warp][filled])[pixel.lane] = effect.y;
          splat = own == filled ? k : splat;
        } while (++filled < kIntersections && todo);
        __syncwarp();

        // The footprint: a row of the patch, then the rows
        const Outline& s = staged[splat];
        const float* of_row = &effects[pixel.warp][own][row * kPatchWidth];
        float moments[3] = {}, sums[kImageFootprintSums];
#pragma unroll
        for (int i = 0; i < kPatchWidth; ++i) {
          const float effect = of_row[i], across = i - 0.5f * (kPatchWidth - 1);
          moments[0] += effect, moments[1] += across * effect, moments[2] += across * across * effect;
        }
        const float dy = row_y - s.place.y;
        footprint_sums(s, moments, row_x - s.place.x - s.place.z * dy, dy, sums);
#pragma unroll
        for (int f = 0; f < kImageFootprintSums; ++f) {
          for (int step = kIntersections; step < 32; step *= 2) sums[f] += __shfl_xor_sync(kAll, sums[f], step);
          if (row == 0 && own < filled) partial[pixel.warp][splat][f] = sums[f];
        }

        // The channels: a part of the patch, then the parts
        float totals[kIntersections] = {};
#pragma unroll
        for (int q = 0; q < kFours; ++q)
#pragma unroll
          for (int k = 0; k < kIntersections; ++k) {
            const float4 w = weights[pixel.warp][k][part * kFours + q];
            totals[k] += w.x * of_channel[4 * q] + w.y * of_channel[4 * q + 1] + w.z * of_channel[4 * q + 2] +
                         w.w * of_channel[4 * q + 3];
          }
#pragma unroll
        for (int k = 0; k < kIntersections; ++k) {
          for (int step = kChannels; step < 32; step *= 2) totals[k] += __shfl_xor_sync(kAll, totals[k], step);
          const int of = __shfl_sync(kAll, splat, k);
          if (k < filled && part == 0) partial[pixel.warp][of][kImageFootprintSums + channel] = totals[k];
        }
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

unsigned tiles_of(const Image& image) {
  return unsigned(image.count * tile_count(image.tile, image.width_px, image.height_px));
}

}  // namespace

void composite_features(const Splats<float>& splats, const Image& image, const int64_t* ranges,
                        const Intersections& intersections, const Features<float>& features, float* out,
                        Stream stream) {
  const unsigned tiles = tiles_of(image);
  if (tiles == 0) return;
  for (Chunk chunk{0, 0}; chunk.first < features.channels; chunk.first += kForwardChunk) {
    chunk.used = int(min(int64_t(kForwardChunk), features.channels - chunk.first));
    const auto kernel = chunk.used <= 4    ? composite_features_kernel<4>
                        : chunk.used <= 16 ? composite_features_kernel<16>
                                           : composite_features_kernel<kForwardChunk>;
    kernel<<<tiles, kThreads, 0, cudaStream_t(stream)>>>(splats, image, ranges, intersections, features, chunk, out);
    check_launch("composite_features");
  }
}

void composite_median_depth(const Splats<float>& splats, const Image& image, const int64_t* ranges,
                            const Intersections& intersections, float* out, Stream stream) {
  const unsigned tiles = tiles_of(image);
  if (tiles == 0) return;
  composite_median_depth_kernel<<<tiles, kThreads, 0, cudaStream_t(stream)>>>(splats, image, ranges, intersections,
                                                                              out);
  check_launch("composite_median_depth");
}

void composite_features_backward(const Splats<float>& splats, const Image& image, const int64_t* ranges,
                                 const Intersections& intersections, const IntersectionRange* intersection_ranges,
                                 const Features<float>& features, float* intersection_gradients, float* sums,
                                 float* g_features, Stream stream) {
  const unsigned tiles = tiles_of(image);
  const int64_t items = splats.images * splats.count;
  check(cudaMemsetAsync(sums, 0, size_t(items) * kSplatSums * sizeof(float), cudaStream_t(stream)),
        "composite_features_backward");
  if (tiles == 0) return;
  for (Chunk chunk{0, 0}; chunk.first < features.channels; chunk.first += kFeatureChunk) {
    chunk.used = int(min(int64_t(kFeatureChunk), features.channels - chunk.first));
    const bool few = chunk.used <= 4;
    const auto kernel = few ? composite_features_backward_kernel<4> : composite_features_backward_kernel<kFeatureChunk>;
    kernel<<<tiles, kThreads, 0, cudaStream_t(stream)>>>(splats, image, ranges, intersections, features, chunk,
                                                         intersection_gradients);
    check_launch("composite_features_backward");
    sum_feature_intersections(items, intersection_ranges, intersection_gradients, few ? 4 : kFeatureChunk,
                              {sums, g_features, features.channels, chunk.first, chunk.used}, stream);
  }
}

}  // namespace lfgs::cuda
