// Between the reverses of composite and project for ordinary images on the device: adds up the slots of each splat, and
// leaves the sum in the first of them. It reads every slot once, in a fixed order, in double.
//
// Splats have a few slots, but one that fills the image has thousands. A warp takes one splat after the other of its
// 32, and a block together those of many slots. Lanes share the numbers of a slot, so that they read memory side by
// side, and as many slots at once as they have numbers for.
#include "cuda/common/check.h"
#include "cuda/stages/stages.h"

namespace lfgs::cuda {
namespace {

constexpr int kThreads = 256, kWarps = kThreads / 32;
constexpr uint32_t kMany = 256;  // slots for which a block comes together

// The sum over every `step`-th slot of a range, from `begin` on, of the number that this lane has.
template <int kNumbers>
__device__ double strided_sum(const float* slots, uint32_t begin, uint32_t end, uint32_t step, int number) {
  double sum = 0;
#pragma unroll 8
  for (uint32_t slot = begin; slot < end; slot += step) sum += slots[int64_t(slot) * kNumbers + number];
  return sum;
}

// A block has the splats of its threads.
template <int kNumbers>
__global__ void __launch_bounds__(kThreads)
    sum_slots_kernel(int64_t splats, const SlotRange* slot_ranges, float* slots) {
  constexpr int kGroups = 32 / kNumbers;  // slots that a warp reads at once; the lanes that are left over read none
  __shared__ SlotRange ranges[kThreads];
  __shared__ unsigned many[kWarps];
  __shared__ double partial[kWarps][kNumbers];
  const int64_t i = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  const int lane = threadIdx.x % 32, warp = threadIdx.x / 32, group = lane / kNumbers, number = lane % kNumbers;
  const SlotRange own = i < splats ? slot_ranges[i] : SlotRange{0, 0};
  const uint32_t count = own.last - own.first;
  ranges[threadIdx.x] = own;
  const unsigned of_warp = __ballot_sync(~0u, count > kMany);
  if (lane == 0) many[warp] = of_warp;

  // The sum over a splat's slots, from `offset` on every `step`-th; lanes below kNumbers receive it
  const auto sum_of = [&](SlotRange range, uint32_t offset, uint32_t step) {
    const bool busy = group < kGroups;
    const uint32_t begin = range.first + offset + group;
    const double share = busy ? strided_sum<kNumbers>(slots, begin, range.last, step, number) : 0.0;
    double sum = share;
#pragma unroll
    for (int g = 1; g < kGroups; ++g) sum += __shfl_down_sync(~0u, share, g * kNumbers);
    return sum;
  };
  __syncthreads();
  for (unsigned todo = __ballot_sync(~0u, count > 1 && count <= kMany); todo; todo &= todo - 1) {
    const SlotRange range = ranges[32 * warp + __ffs(int(todo)) - 1];
    const double sum = sum_of(range, 0, kGroups);
    if (lane < kNumbers) slots[int64_t(range.first) * kNumbers + lane] = float(sum);
  }

  // Those of many slots, by all warps
  for (int w = 0; w < kWarps; ++w) {
    for (unsigned todo = many[w]; todo; todo &= todo - 1) {
      const SlotRange range = ranges[32 * w + __ffs(int(todo)) - 1];
      const double share = sum_of(range, warp * kGroups, kWarps * kGroups);
      if (lane < kNumbers) partial[warp][lane] = share;
      __syncthreads();
      if (int(threadIdx.x) < kNumbers) {
        double sum = 0;
        for (int k = 0; k < kWarps; ++k) sum += partial[k][threadIdx.x];
        slots[int64_t(range.first) * kNumbers + threadIdx.x] = float(sum);
      }
      __syncthreads();
    }
  }
}

}  // namespace

void sum_slots(int64_t splats, const SlotRange* slot_ranges, bool absolute, float* slot_gradients, Stream stream) {
  if (splats == 0) return;
  const auto kernel = absolute ? sum_slots_kernel<kAbsoluteDenseSums> : sum_slots_kernel<kDenseSums>;
  kernel<<<unsigned(blocks_for(splats, kThreads)), kThreads, 0, cudaStream_t(stream)>>>(splats, slot_ranges,
                                                                                        slot_gradients);
  check_launch("sum_slots");
}

}  // namespace lfgs::cuda
