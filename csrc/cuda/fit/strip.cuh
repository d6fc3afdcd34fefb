// How the kernels of the photo loss walk over images. A block has a strip of kStripSamples samples (32 pixels with
// their three colours, side by side as they lie in memory) and kStripRows rows, a thread one sample of each row. Rows
// come one after the other, with the samples beside the strip in shared memory; a thread blurs along the row, and adds
// the result to the eleven rows of output that it belongs to, which it keeps in registers. So the blur across rows
// reads nothing.
#pragma once

#include <cstdint>

#include "math/fit/ssim.h"

namespace lfgs::cuda {

constexpr int kStripSamples = 96, kStripRows = 32;  // a thread per sample
constexpr int kStripMargin = 3 * kWindowReach;      // samples beside the strip
constexpr int kStripWidth = kStripSamples + 2 * kStripMargin;
constexpr int kBatchRows = 6;  // rows that are read together
constexpr int kStripBatches = (kStripRows + 2 * kWindowReach) / kBatchRows;
static_assert(kStripBatches * kBatchRows == kStripRows + 2 * kWindowReach);

// Where a block's strip lies: its view, and its first row and sample.
struct Strip {
  int64_t view, top, left;
  __device__ Strip()
      : view(blockIdx.z), top(int64_t(blockIdx.y) * kStripRows), left(int64_t(blockIdx.x) * kStripSamples) {}
};

// Rows of one quantity, with their margins.
using BatchRows = float[kBatchRows][kStripWidth];

// Calls read(sample, row of the batch, column) for all that a batch has, with sample -1 beyond the image.
template <class Read>
__device__ void for_batch(const Strip& strip, int batch, int64_t height_px, int64_t row, const Read& read) {
  for (int i = threadIdx.x; i < kBatchRows * kStripWidth; i += kStripSamples) {
    const int r = i / kStripWidth, c = i % kStripWidth;
    const int64_t y = strip.top - kWindowReach + batch * kBatchRows + r, x = strip.left - kStripMargin + c;
    const bool inside = y >= 0 && y < height_px && x >= 0 && x < row;
    read(inside ? (strip.view * height_px + y) * row + x : int64_t(-1), r, c);
  }
}

// The blur across rows of one quantity: pending[0] is complete when eleven rows have been added.
struct Pending {
  float sums[kWindow] = {};
  __device__ void add(float of_row) {
#pragma unroll
    for (int tap = 0; tap < kWindow - 1; ++tap) sums[tap] = fmaf(float(window_tap(tap)), of_row, sums[tap + 1]);
    sums[kWindow - 1] = float(window_tap(kWindow - 1)) * of_row;
  }
  __device__ float complete() const { return sums[0]; }
};

// The blur along a row for the thread's sample.
__device__ inline float blurred_along(const float (&row)[kStripWidth]) {
  float sum = 0;
#pragma unroll
  for (int tap = 0; tap < kWindow; ++tap) sum = fmaf(float(window_tap(tap)), row[threadIdx.x + 3 * tap], sum);
  return sum;
}

}  // namespace lfgs::cuda
