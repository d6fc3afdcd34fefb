// Between the backward passes of composite and project for ordinary images on the device: adds up the intersections of
// each splat. It reads every intersection once, in a fixed order, in double.
//
// Most splats have a few intersections, and one that fills the image has thousands. Lanes share the numbers of an
// intersection, so that they read memory side by side. A warp sums as many splats at once as it has lanes for. Splats
// of many intersections are summed up by a whole block. Neighbours in memory are neighbours in space and of one size:
// warps take splats from far apart, so that none has all the large ones.
#include "cuda/common/launch.h"
#include "cuda/stages/stages.h"

namespace lfgs::cuda {
namespace {

constexpr int kThreads = 256, kWarps = kThreads / 32;
constexpr uint32_t kMany = 64;  // intersections for which a block comes together

// The sum over every `step`-th intersection of a range, from `begin` on, of the number that this lane has. Eight are
// read before the first is added, or each would wait for memory by itself.
template <int kNumbers>
__device__ double strided_sum(const float* indices, uint32_t begin, uint32_t end, uint32_t step, int number) {
  constexpr int kAtOnce = 8;
  double sum = 0;
  for (uint32_t index = begin; index < end; index += kAtOnce * step) {
    float values[kAtOnce];
#pragma unroll
    for (int k = 0; k < kAtOnce; ++k) {
      const uint32_t at = index + k * step;
      values[k] = at < end ? indices[int64_t(at) * kNumbers + number] : 0.f;
    }
#pragma unroll
    for (int k = 0; k < kAtOnce; ++k) sum += values[k];
  }
  return sum;
}

// Where the sums of a splat go: those of images, and those of a chunk of features (FeatureSums).
struct ToSums {
  float* sums;
  __device__ void store(int64_t splat, unsigned number, float sum) const { sums[splat * kSplatSums + number] = sum; }
};
struct ToFeatures {
  FeatureSums out;
  __device__ void store(int64_t splat, unsigned number, float sum) const {
    const int channel = int(number) - kImageFootprintSums;
    if (channel < 0)
      out.sums[splat * kSplatSums + number] += sum;
    else if (channel < out.used)
      out.g_features[splat * out.channels + out.first + channel] = sum;
  }
};

// Each thread of the grid brings one splat into its block. The first of a warp is `warp`, and the others follow at the
// distance of the number of warps.
template <int kNumbers, class Out>
__global__ void __launch_bounds__(kThreads)
    sum_intersections_kernel(int64_t splats, const IntersectionRange* intersection_ranges, const float* indices,
                             Out out) {
  constexpr int kGroups = 32 / kNumbers;  // splats that a warp sums up at once; the lanes that are left over do nothing
  __shared__ IntersectionRange ranges[kThreads];
  __shared__ unsigned many[kWarps];
  __shared__ double partial[kWarps][kGroups][kNumbers];
  const int lane = threadIdx.x % 32, warp = threadIdx.x / 32, group = lane / kNumbers, number = lane % kNumbers;
  const int64_t apart = int64_t(gridDim.x) * kWarps, first = int64_t(blockIdx.x) * kWarps + warp;
  const int64_t i = first + lane * apart;
  const IntersectionRange own = i < splats ? intersection_ranges[i] : IntersectionRange{0, 0};
  const uint32_t count = own.last - own.first;
  ranges[threadIdx.x] = own;
  const unsigned of_warp = __ballot_sync(~0u, count > kMany);
  if (lane == 0) many[warp] = of_warp;
  __syncthreads();

  // Splats of a few intersections or none, each by a group of lanes
  for (unsigned todo = __ballot_sync(~0u, i < splats && count <= kMany); todo;) {
    int own_lane = -1;
#pragma unroll
    for (int g = 0; g < kGroups; ++g, todo &= todo - 1)
      if (todo && g == group) own_lane = __ffs(int(todo)) - 1;
    if (own_lane < 0) continue;
    const IntersectionRange range = ranges[32 * warp + own_lane];
    const double sum = strided_sum<kNumbers>(indices, range.first, range.last, 1, number);
    out.store(first + own_lane * apart, number, float(sum));
  }

  // Splats of many intersections, each by all warps
  for (int w = 0; w < kWarps; ++w) {
    for (unsigned todo = many[w]; todo; todo &= todo - 1) {
      const int own_lane = __ffs(int(todo)) - 1;
      const IntersectionRange range = ranges[32 * w + own_lane];
      const uint32_t begin = range.first + warp * kGroups + group;
      if (group < kGroups)
        partial[warp][group][number] = strided_sum<kNumbers>(indices, begin, range.last, kWarps * kGroups, number);
      __syncthreads();
      if (int(threadIdx.x) < kNumbers) {
        double sum = 0;
        for (int k = 0; k < kWarps; ++k)
          for (int g = 0; g < kGroups; ++g) sum += partial[k][g][threadIdx.x];
        out.store(first - warp + w + own_lane * apart, threadIdx.x, float(sum));
      }
      __syncthreads();
    }
  }
}

}  // namespace

void sum_intersections(int64_t splats, const IntersectionRange* intersection_ranges, bool absolute,
                       const float* intersection_gradients, float* sums, Stream stream) {
  if (splats == 0) return;
  const auto kernel =
      absolute ? sum_intersections_kernel<kAbsoluteImageSums, ToSums> : sum_intersections_kernel<kImageSums, ToSums>;
  kernel<<<unsigned(blocks_for(splats, kThreads)), kThreads, 0, cudaStream_t(stream)>>>(
      splats, intersection_ranges, intersection_gradients, ToSums{sums});
  check_launch("sum_intersections");
}

void sum_feature_intersections(int64_t splats, const IntersectionRange* intersection_ranges,
                               const float* intersection_gradients, int width, const FeatureSums& out, Stream stream) {
  if (splats == 0) return;
  const auto kernel = width == 4 ? sum_intersections_kernel<kImageFootprintSums + 4, ToFeatures>
                                 : sum_intersections_kernel<kFeatureSums, ToFeatures>;
  kernel<<<unsigned(blocks_for(splats, kThreads)), kThreads, 0, cudaStream_t(stream)>>>(
      splats, intersection_ranges, intersection_gradients, ToFeatures{out});
  check_launch("sum_feature_intersections");
}

}  // namespace lfgs::cuda
