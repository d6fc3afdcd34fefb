#pragma once

#include <cuda_runtime.h>

#include <type_traits>

namespace cub {

struct DeviceScan {
  template <class I, class O, class N>
  static cudaError_t InclusiveSum(void* temporary, size_t& bytes, I in, O out, N count, cudaStream_t = 0) {
    if (!temporary) return bytes = 256, cudaSuccess;
    std::remove_cvref_t<decltype(out[0])> sum = 0;
    for (N i = 0; i < count; ++i) out[i] = sum += in[i];
    return cudaSuccess;
  }
};

}  // namespace cub
