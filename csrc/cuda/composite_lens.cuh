// What the kernels that composite a light-field frame share: their lists, the hand-out of tiles, storing.
#pragma once

#include "cuda/check.h"
#include "cuda/lens_frame.h"

namespace lfgs::cuda {

__device__ inline float fast_exp2(float x) {
  float y;
  asm("ex2.approx.ftz.f32 %0, %1;" : "=f"(y) : "f"(x));
  return y;
}

// The splats of a list, nearest first. A frame with more pairs than places has no lists: then all that is drawn.
struct List {
  const uint32_t* ids;
  unsigned count;

  __device__ List(const LensFrame& frame, int64_t number) {
    if (frame.state->pairs > frame.capacity) {
      ids = frame.order, count = frame.state->drawn;
    } else {
      const unsigned begin = frame.ranges[2 * number];
      ids = frame.sorted_values + begin, count = frame.ranges[2 * number + 1] - begin;
    }
  }
};

// The next piece of work of a block that has done one. By all its threads.
__device__ inline unsigned next_unit(const LensFrame& frame, LensKernel kernel, unsigned& shared) {
  __syncthreads();
  if (threadIdx.x == 0) shared = gridDim.x + atomicAdd(&frame.state->next_tile[int(kernel)], 1u);
  __syncthreads();
  return shared;
}

// Blocks that the device holds at a time.
template <class Kernel>
unsigned resident_blocks(Kernel kernel, int threads, size_t shared_bytes) {
  int device = 0, processors = 0, blocks = 0;
  check(cudaGetDevice(&device), "composite: device");
  check(cudaDeviceGetAttribute(&processors, cudaDevAttrMultiProcessorCount, device), "composite: multiprocessors");
  check(cudaOccupancyMaxActiveBlocksPerMultiprocessor(&blocks, kernel, threads, shared_bytes), "composite: occupancy");
  return unsigned(processors * (blocks > 0 ? blocks : 1));
}

__device__ inline float stored(float c, float*) { return c; }
__device__ inline uint8_t stored(float c, uint8_t*) {
  return uint8_t(__float2uint_rn(fminf(fmaxf(c, 0.f), 1.f) * 255.f));
}

// Two neighbouring pixels, the first in an even column; values by place.
template <class Out>
__device__ void store_pixels(const LensOptics& lens, int column, int row, const float (&values)[6], Out* out) {
  if (row >= lens.height_px || column >= lens.width_px) return;
  Out bytes[6];
#pragma unroll
  for (int i = 0; i < 6; ++i) bytes[i] = stored(lens.bgr ? values[i / 3 * 3 + 2 - i % 3] : values[i], out);
  Out* to = out + 3 * (int64_t(row) * lens.width_px + column);
  if (sizeof(Out) == 1 && lens.width_px % 2 == 0) {
#pragma unroll
    for (int i = 0; i < 6; i += 2)
      reinterpret_cast<uint16_t*>(to)[i / 2] = uint16_t(unsigned(bytes[i]) | unsigned(bytes[i + 1]) << 8);
  } else {
    for (int i = 0; i < (column + 1 < lens.width_px ? 6 : 3); ++i) to[i] = bytes[i];
  }
}

}  // namespace lfgs::cuda
