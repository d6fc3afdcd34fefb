// Group normalisation of feature maps, followed by SiLU. A block has one group of channels of one image. It reads the
// group twice: first for mean and variance, then (from the cache) to write the result. A thread has two channels in
// some of the pixels.
#include "network/group_norm.h"

#include "cuda/common/blend.cuh"
#include "cuda/common/launch.h"

namespace lfgs::cuda {
namespace {

constexpr int kThreads = 512, kWarps = kThreads / 32;

// The two bfloat16 of a word.
__device__ inline float2 floats(uint32_t pair) {
  return make_float2(__uint_as_float(pair << 16), __uint_as_float(pair & 0xffff0000u));
}
// Round to bfloat16, to nearest with ties to even; the result is in the upper half.
__device__ inline uint32_t rounded_bits(float a) {
  const uint32_t bits = __float_as_uint(a);
  return a == a ? bits + 0x7fffu + (bits >> 16 & 1) : 0x7fff0000u;  // rounding could turn the bits of a NaN into zero
}
__device__ inline uint32_t pack(float low, float high) {
  return rounded_bits(low) >> 16 | (rounded_bits(high) & 0xffff0000u);
}

// The sum over all threads of the block, in a fixed order; every thread receives it.
__device__ float block_sum(float a, float (&parts)[kWarps]) {
  a = warp_sum(a);
  __syncthreads();
  if (threadIdx.x % 32 == 0) parts[threadIdx.x / 32] = a;
  __syncthreads();
  float sum = 0;
  for (int w = 0; w < kWarps; ++w) sum += parts[w];
  return sum;
}

__device__ inline float silu(float x) { return x * fast_reciprocal(1 + fast_exp2(-1.44269504f * x)); }

__global__ void __launch_bounds__(kThreads)
    group_norm_silu_kernel(FeatureMaps maps, const uint32_t* in, const uint32_t* weight, const uint32_t* bias,
                           float eps, uint32_t* out) {
  __shared__ float parts[kWarps];
  const int image = blockIdx.x / maps.groups, group = blockIdx.x % maps.groups;
  const int row = maps.channels / 2, pairs = row / maps.groups, first = group * pairs;

  // Every thread stays with two channels; the last few threads of a block may have none
  const int together = kThreads / pairs, pair = first + threadIdx.x % pairs;
  const int64_t start = threadIdx.x / pairs < together ? threadIdx.x / pairs : maps.pixels;
  const int64_t origin = int64_t(image) * maps.pixels * row;
  in += origin, out += origin;

  // Mean and variance. They are summed as differences to one of the numbers, so that large means do not take the digits
  const float about = floats(in[first]).x;
  float sum = 0, squares = 0;
#pragma unroll 4
  for (int64_t p = start; p < maps.pixels; p += together) {
    const float2 v = floats(in[p * row + pair]);
    const float a = v.x - about, b = v.y - about;
    sum += a + b, squares = fmaf(a, a, fmaf(b, b, squares));
  }
  const float inverse = 1 / (2 * float(pairs) * float(maps.pixels));
  const float mean = block_sum(sum, parts) * inverse;
  const float variance = fmaxf(block_sum(squares, parts) * inverse - mean * mean, 0.f);
  const float scale = 1 / sqrtf(variance + eps);

  // Normalise: weight and bias of the two channels become one multiplication and one addition
  const float2 w = floats(weight[pair]), b = floats(bias[pair]);
  const float2 by = make_float2(w.x * scale, w.y * scale);
  const float2 plus = make_float2(fmaf(-(about + mean), by.x, b.x), fmaf(-(about + mean), by.y, b.y));
#pragma unroll 4
  for (int64_t p = start; p < maps.pixels; p += together) {
    const float2 v = floats(in[p * row + pair]);
    out[p * row + pair] = pack(silu(fmaf(v.x, by.x, plus.x)), silu(fmaf(v.y, by.y, plus.y)));
  }
}

}  // namespace

void group_norm_silu(const FeatureMaps& maps, const uint32_t* in, const uint32_t* weight, const uint32_t* bias,
                     float eps, uint32_t* out, Stream stream) {
  require(maps.groups > 0 && maps.channels % (2 * maps.groups) == 0 && maps.channels / maps.groups <= 2 * kThreads,
          "group_norm_silu needs an even number of channels in each group, at most " + std::to_string(2 * kThreads) +
              ", got " + std::to_string(maps.channels) + " in " + std::to_string(maps.groups) + " groups");
  if (maps.images == 0 || maps.pixels == 0) return;
  group_norm_silu_kernel<<<unsigned(maps.images * maps.groups), kThreads, 0, cudaStream_t(stream)>>>(maps, in, weight,
                                                                                                     bias, eps, out);
  check_launch("group_norm_silu");
}

}  // namespace lfgs::cuda
