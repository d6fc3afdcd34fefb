// The loss of images against photographs, and its gradient, in two kernels. The first blurs the five moments, and
// writes the derivatives of SSIM and the sum of each block. The second blurs the derivatives and writes the gradient;
// its first block adds up the sums, in a fixed order.
//
// Floors at 1008 x 756 pixels (2.29 million samples) on an H100 (3.35 TB/s, 132 x 128 multiply-adds at 1.7 GHz).
//   bytes: the first kernel reads 9 MB of image and 2 MB of photo, and writes 27 MB. The second reads these and writes
//     9 MB. That is 87 MB, 0.026 ms, less the derivatives that stay in the cache of 50 MB.
//   arithmetic: 11 x (5 + 5) multiply-adds and about 60 more for each of 42 rows, of which 32 are written. Then
//     11 x (3 + 3) and about 20: 340 instructions a sample, 0.027 ms. Also 55 x 1.3 reads of shared memory, 32 a
//     clock and multiprocessor, 0.023 ms.
#include <cstdint>

#include "cuda/common/launch.h"
#include "cuda/fit/fit.h"
#include "math/fit/photo_loss.h"

namespace lfgs::cuda {
namespace {

// The walk of the kernels over images. A block has a strip of kStripSamples samples (32 pixels of three colours, side
// by side) and kStripRows rows. A thread has one sample of each row. Rows come one after the other, with the samples
// beside the strip in shared memory. A thread blurs along the row, and adds the result to the eleven rows of output
// that it belongs to. It keeps these in registers. So the blur across rows reads nothing.
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

// Call read(sample, row of the batch, column) for all that a batch has, with sample -1 beyond the image.
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

// The sum over all threads of the block in a fixed order.
__device__ double block_sum(double value) {
  __shared__ double parts[kStripSamples / 32];
  for (int apart = 16; apart > 0; apart /= 2) value += __shfl_xor_sync(~0u, value, apart);
  if (threadIdx.x % 32 == 0) parts[threadIdx.x / 32] = value;
  __syncthreads();
  double sum = 0;
  for (double of_warp : parts) sum += of_warp;
  return sum;
}

// Blurred moments of a sample, while rows come in.
struct PendingMoments {
  Pending x, y, xx, yy, xy;

  __device__ void add_row(const float (&image)[kStripWidth], const float (&photo)[kStripWidth]) {
    SsimMoments<float> m{};
#pragma unroll
    for (int tap = 0; tap < kWindow; ++tap) {
      const float a = image[threadIdx.x + 3 * tap], b = photo[threadIdx.x + 3 * tap];
      const float wa = float(window_tap(tap)) * a, wb = float(window_tap(tap)) * b;
      m.x += wa, m.y += wb, m.xx = fmaf(wa, a, m.xx), m.yy = fmaf(wb, b, m.yy), m.xy = fmaf(wa, b, m.xy);
    }
    x.add(m.x), y.add(m.y), xx.add(m.xx), yy.add(m.yy), xy.add(m.xy);
  }
  __device__ SsimMoments<float> complete() const {
    return {x.complete(), y.complete(), xx.complete(), yy.complete(), xy.complete()};
  }
};

// The first kernel's work on a sample whose moments are complete. Return its part of the loss.
__device__ float write_derivatives(const PhotoLoss<float>& job, const SsimMoments<float>& moments, int64_t sample) {
  const Ssim<float> ssim = compute_ssim(moments);
  const float w = job.weight_at(sample), y = job.photo_at(sample);
  const int64_t samples = job.samples();
  job.derivatives[sample] = w * ssim.by_x;
  job.derivatives[sample + samples] = w * ssim.by_xx;
  job.derivatives[sample + 2 * samples] = w * ssim.by_xy;
  return sample_loss(job.image_at(sample, y, w), y, w, ssim.value, float(job.ssim_lambda));
}

__global__ void __launch_bounds__(kStripSamples) derivatives_kernel(PhotoLoss<float> job) {
  __shared__ BatchRows image, photo;
  const Strip strip;
  const int64_t row = job.row(), column = strip.left + threadIdx.x;
  PendingMoments pending;
  float loss = 0;
  for (int batch = 0; batch < kStripBatches; ++batch) {
    __syncthreads();
    for_batch(strip, batch, job.height_px, row, [&](int64_t sample, int r, int c) {
      const float y = sample >= 0 ? job.photo_at(sample) : 0.f;
      photo[r][c] = y;
      image[r][c] = sample >= 0 ? job.image_at(sample, y, job.weight_at(sample)) : 0.f;
    });
    __syncthreads();
    for (int r = 0; r < kBatchRows; ++r) {
      pending.add_row(image[r], photo[r]);
      const int done = batch * kBatchRows + r - 2 * kWindowReach;  // the row of the strip that is complete
      const int64_t y = strip.top + done;
      if (done >= 0 && y < job.height_px && column < row)
        loss += write_derivatives(job, pending.complete(), (strip.view * job.height_px + y) * row + column);
    }
  }
  const double sum = block_sum(loss);
  const int64_t block = (int64_t(blockIdx.z) * gridDim.y + blockIdx.y) * gridDim.x + blockIdx.x;
  if (threadIdx.x == 0) job.partials[block] = sum;
}

// Add up the sums of the first kernel's blocks.
__device__ void write_loss(const PhotoLoss<float>& job) {
  const int64_t blocks = int64_t(gridDim.x) * gridDim.y * gridDim.z;
  double sum = 0;
  for (int64_t i = threadIdx.x; i < blocks; i += kStripSamples) sum += job.partials[i];
  sum = block_sum(sum);
  if (threadIdx.x == 0) *job.loss = float(sum * job.sample_weight());
}

// The second kernel's work on a sample.
__device__ void write_gradient(const PhotoLoss<float>& job, const Pending (&by)[3], int64_t sample) {
  const float w = job.weight_at(sample), y = job.photo_at(sample), x = job.image_at(sample, y, w);
  const float ssim_by_x = ssim_gradient(by[0].complete(), by[1].complete(), by[2].complete(), x, y);
  job.gradient[sample] = float(job.sample_weight()) * sample_gradient(x, y, w, ssim_by_x, float(job.ssim_lambda));
}

__global__ void __launch_bounds__(kStripSamples) gradient_kernel(PhotoLoss<float> job) {
  __shared__ BatchRows derivatives[3];
  const Strip strip;
  const int64_t row = job.row(), column = strip.left + threadIdx.x, samples = job.samples();
  Pending pending[3];
  for (int batch = 0; batch < kStripBatches; ++batch) {
    __syncthreads();
    for_batch(strip, batch, job.height_px, row, [&](int64_t sample, int r, int c) {
#pragma unroll
      for (int d = 0; d < 3; ++d) derivatives[d][r][c] = sample >= 0 ? job.derivatives[sample + d * samples] : 0.f;
    });
    __syncthreads();
    for (int r = 0; r < kBatchRows; ++r) {
#pragma unroll
      for (int d = 0; d < 3; ++d) pending[d].add(blurred_along(derivatives[d][r]));
      const int done = batch * kBatchRows + r - 2 * kWindowReach;
      const int64_t y = strip.top + done;
      if (done >= 0 && y < job.height_px && column < row)
        write_gradient(job, pending, (strip.view * job.height_px + y) * row + column);
    }
  }
  if (blockIdx.x == 0 && blockIdx.y == 0 && blockIdx.z == 0) write_loss(job);
}

dim3 strips(int64_t images, int64_t height_px, int64_t width_px) {
  return {unsigned(blocks_for(3 * width_px, kStripSamples)), unsigned(blocks_for(height_px, kStripRows)),
          unsigned(images)};
}

}  // namespace

int64_t photo_loss_partials(int64_t images, int64_t height_px, int64_t width_px) {
  return images * blocks_for(height_px, kStripRows) * blocks_for(3 * width_px, kStripSamples);
}

void photo_loss(const PhotoLoss<float>& job, Stream stream) {
  require(job.images <= kMostImages && blocks_for(job.height_px, kStripRows) <= kMostImages,
          std::to_string(job.images) + " images of " + std::to_string(job.height_px) +
              " rows are too many for one call on CUDA: at most 65,535 images and 2,097,120 rows");
  const dim3 blocks = strips(job.images, job.height_px, job.width_px);
  derivatives_kernel<<<blocks, kStripSamples, 0, cudaStream_t(stream)>>>(job);
  check_launch("photo_loss");
  gradient_kernel<<<blocks, kStripSamples, 0, cudaStream_t(stream)>>>(job);
  check_launch("photo_loss, gradient");
}

}  // namespace lfgs::cuda
