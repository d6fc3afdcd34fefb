// Write 0, 1, 2, ..., which sorts take for the places that things had before.
#pragma once

#include <cstdint>

#include "cuda/common/check.h"

namespace lfgs::cuda {

// A thread has a number.
static __global__ void count_up_kernel(int64_t items, uint32_t* numbers) {
  const int64_t i = int64_t(blockIdx.x) * blockDim.x + threadIdx.x;
  if (i < items) numbers[i] = uint32_t(i);
}

inline void count_up(int64_t items, uint32_t* numbers, cudaStream_t stream) {
  constexpr int kThreads = 256;
  if (items == 0) return;
  count_up_kernel<<<unsigned(blocks_for(items, kThreads)), kThreads, 0, stream>>>(items, numbers);
  check_launch("count_up");
}

}  // namespace lfgs::cuda
