#pragma once

#include <cuda_runtime.h>

namespace cub {

struct DeviceReduce {
  template <class I, class O, class N>
  static cudaError_t Sum(void* temporary, size_t& bytes, I in, O out, N count, cudaStream_t = 0) {
    if (!temporary) return bytes = 256, cudaSuccess;
    *out = 0;
    for (N i = 0; i < count; ++i) *out += in[i];
    return cudaSuccess;
  }
};

}  // namespace cub
