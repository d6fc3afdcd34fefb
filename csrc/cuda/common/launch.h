// For the host code around kernels: errors of CUDA and CUB, sizes of launches, and several arrays in one buffer.
#pragma once

#include <cuda_runtime.h>

#include <cstddef>
#include <cstdint>
#include <string>

#include "base/config.h"
#include "base/error.h"

namespace lfgs::cuda {

// Throws when a call of CUDA or CUB failed.
inline void check(cudaError_t status, const char* what) {
  if (status != cudaSuccess) throw Error(std::string(what) + ": CUDA says " + cudaGetErrorString(status));
}

// After a launch: reports a configuration that the device refused.
inline void check_launch(const char* kernel) { check(cudaGetLastError(), kernel); }

// How many blocks it takes for all items, `per_block` each.
LFGS_HD int64_t blocks_for(int64_t items, int64_t per_block) { return (items + per_block - 1) / per_block; }

// How many blocks of a kernel the device holds at a time: at least one on each multiprocessor.
template <class Kernel>
unsigned resident_blocks(Kernel kernel, int threads, size_t shared_bytes) {
  int device = 0, processors = 0, blocks = 0;
  check(cudaGetDevice(&device), "device");
  check(cudaDeviceGetAttribute(&processors, cudaDevAttrMultiProcessorCount, device), "multiprocessors");
  check(cudaOccupancyMaxActiveBlocksPerMultiprocessor(&blocks, kernel, threads, shared_bytes), "occupancy");
  return unsigned(processors * (blocks > 0 ? blocks : 1));
}

// Hand out aligned parts of one buffer. When the buffer is null it only counts how long it must be.
struct Parts {
  char* base;
  size_t used = 0;

  template <class T>
  void take(T*& part, int64_t count) {
    used = (used + 255) / 256 * 256;
    part = reinterpret_cast<T*>(base ? base + used : nullptr);
    used += size_t(count) * sizeof(T);
  }
};

}  // namespace lfgs::cuda
