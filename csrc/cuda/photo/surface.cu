// Where the sheet over a photo lies: a thread has a pixel, of a layer or of a plane.
#include "cuda/common/check.h"
#include "cuda/photo/photo.h"

namespace lfgs::cuda {
namespace {

constexpr int kThreads = 128;

__device__ int64_t own_pixel() { return int64_t(blockIdx.x) * kThreads + threadIdx.x; }

__global__ void __launch_bounds__(kThreads) weigh_kernel(const __grid_constant__ Surface job) {
  if (own_pixel() < job.pixels()) weigh(job, blockIdx.y, own_pixel());
}

// Blur the planes of a set into another, along rows or along columns.
__global__ void __launch_bounds__(kThreads)
    blur_kernel(const __grid_constant__ Surface job, Blur blur, int from, int to, bool down) {
  const int64_t pixel = own_pixel(), row = pixel / job.width, column = pixel % job.width;
  if (pixel >= job.pixels()) return;
  auto weight = [&](int k) { return blur.weight(k); };
  const float* in = job.plane(from, blockIdx.y) + pixel;
  job.plane(to, blockIdx.y)[pixel] = down ? blurred_at(in, job.width, row, job.height, blur.reach, weight)
                                          : blurred_at(in, 1, column, job.width, blur.reach, weight);
}

__global__ void __launch_bounds__(kThreads) look_through_kernel(const __grid_constant__ Surface job) {
  if (own_pixel() < job.pixels()) look_through(job, own_pixel());
}

__global__ void __launch_bounds__(kThreads) finish_surface_kernel(const __grid_constant__ Surface job) {
  if (own_pixel() < job.pixels()) finish_surface(job, own_pixel());
}

}  // namespace

void surface(const Surface& job, Stream stream) {
  const unsigned blocks = unsigned(blocks_for(job.pixels(), kThreads));
  const dim3 layers(blocks, job.layers), fog(blocks, job.fog_planes()), seen(blocks, job.seen_planes());
  const Blur blur = Blur::of(job.look.averaged);
  weigh_kernel<<<layers, kThreads, 0, cudaStream_t(stream)>>>(job);
  blur_kernel<<<fog, kThreads, 0, cudaStream_t(stream)>>>(job, blur, 0, 1, false);
  blur_kernel<<<fog, kThreads, 0, cudaStream_t(stream)>>>(job, blur, 1, 2, true);
  look_through_kernel<<<blocks, kThreads, 0, cudaStream_t(stream)>>>(job);
  blur_kernel<<<seen, kThreads, 0, cudaStream_t(stream)>>>(job, blur, 1, 2, false);
  blur_kernel<<<seen, kThreads, 0, cudaStream_t(stream)>>>(job, blur, 2, 0, true);
  finish_surface_kernel<<<blocks, kThreads, 0, cudaStream_t(stream)>>>(job);
  check_launch("surface");
}

}  // namespace lfgs::cuda
