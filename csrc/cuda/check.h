// Every status of CUDA and CUB is looked at.
#pragma once

#include <cuda_runtime.h>

#include <string>

#include "base/error.h"

namespace lfgs::cuda {

inline void check(cudaError_t status, const char* what) {
  if (status != cudaSuccess) throw Error(std::string(what) + ": CUDA says " + cudaGetErrorString(status));
}

// After a launch: reports a configuration that the device refused.
inline void check_launch(const char* kernel) { check(cudaGetLastError(), kernel); }

inline int64_t blocks_for(int64_t items, int64_t per_block) { return (items + per_block - 1) / per_block; }

}  // namespace lfgs::cuda
