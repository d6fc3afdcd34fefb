// The sheet over a photo, and the surface on which it lies. In the kernels of the surface a thread has a pixel of a
// layer or of a plane. In the kernels of the sheet a thread has a texel, and a block a piece of a row. Three floats a
// texel go through shared memory, so that a warp writes consecutive addresses.
#include "cuda/common/launch.h"
#include "cuda/photo/photo.h"

namespace lfgs::cuda {
namespace {

constexpr int kPixelThreads = 128, kTexelThreads = 256;

__device__ int64_t own_pixel() { return int64_t(blockIdx.x) * kPixelThreads + threadIdx.x; }

__global__ void __launch_bounds__(kPixelThreads) weigh_kernel(const __grid_constant__ Surface job) {
  if (own_pixel() < job.pixels()) weigh(job, blockIdx.y, own_pixel());
}

// Blur the planes of a set into another, along rows or along columns.
__global__ void __launch_bounds__(kPixelThreads)
    blur_kernel(const __grid_constant__ Surface job, Blur blur, int from, int to, bool down) {
  const int64_t pixel = own_pixel(), row = pixel / job.width, column = pixel % job.width;
  if (pixel >= job.pixels()) return;
  auto weight = [&](int k) { return blur.weight(k); };
  const float* in = job.plane(from, blockIdx.y) + pixel;
  job.plane(to, blockIdx.y)[pixel] = down ? blurred_at(in, job.width, row, job.height, blur.reach, weight)
                                          : blurred_at(in, 1, column, job.width, blur.reach, weight);
}

__global__ void __launch_bounds__(kPixelThreads) look_through_kernel(const __grid_constant__ Surface job) {
  if (own_pixel() < job.pixels()) look_through(job, own_pixel());
}

__global__ void __launch_bounds__(kPixelThreads) finish_surface_kernel(const __grid_constant__ Surface job) {
  if (own_pixel() < job.pixels()) finish_surface(job, own_pixel());
}

__global__ void __launch_bounds__(kTexelThreads) prepare_kernel(const __grid_constant__ Sheet job, Blur blur) {
  const int64_t column = int64_t(blockIdx.x) * kTexelThreads + threadIdx.x;
  auto weight = [&](int k) { return blur.weight(k); };
  if (column < job.columns()) prepare_texel(job, blur.reach, weight, blockIdx.y, column);
}

template <class Pass>
__global__ void __launch_bounds__(kTexelThreads) ramp_kernel(const __grid_constant__ Sheet job, Pass pass) {
  const int64_t column = int64_t(blockIdx.x) * kTexelThreads + threadIdx.x;
  if (column < job.columns()) pass(job, blockIdx.y, column);
}

// Write the vectors of a block's first `count` threads.
__device__ void store_vectors(const glm::vec3& mine, int count, float (&shared)[3 * kTexelThreads], float* to) {
  for (int c = 0; c < 3; ++c) shared[3 * threadIdx.x + c] = mine[c];
  __syncthreads();
  for (int k = threadIdx.x; k < 3 * count; k += kTexelThreads) to[k] = shared[k];
  __syncthreads();
}

__global__ void __launch_bounds__(kTexelThreads) finish_kernel(const __grid_constant__ Sheet job, Blur blur) {
  __shared__ float shared[3 * kTexelThreads];
  const int64_t row = blockIdx.y, first = int64_t(blockIdx.x) * kTexelThreads, column = first + threadIdx.x;
  const int64_t texel = row * job.columns() + first;
  const int count = int(min(int64_t(kTexelThreads), job.columns() - first));
  const bool inside = int(threadIdx.x) < count;
  auto weight = [&](int k) { return blur.weight(k); };
  TexelGaussian found{};
  if (inside) found = finish_texel(job, blur.reach, weight, row, column);

  store_vectors(found.mean, count, shared, job.out.means + 3 * texel);
  store_vectors(found.scale, count, shared, job.out.scales + 3 * texel);
  if (job.out.sh_degree == 0) store_vectors(found.constant, count, shared, job.out.sh + 3 * texel);
  if (!inside) return;
  const int64_t i = texel + threadIdx.x;
  const glm::vec4 q = found.quaternion;
  reinterpret_cast<float4*>(job.out.quaternions)[i] = make_float4(q.x, q.y, q.z, q.w);
  job.out.opacities[i] = found.opacity;
  if (job.out.sh_degree == 0) return;
  for (int c = 0; c < 3; ++c) job.out.sh[3 * job.out.sh_count() * i + c] = found.constant[c];
  store_harmonics(job, row, column);
}

}  // namespace

void surface(const Surface& job, Stream stream) {
  const unsigned blocks = unsigned(blocks_for(job.pixels(), kPixelThreads));
  const dim3 layers(blocks, job.layers), fog(blocks, job.fog_planes()), seen(blocks, job.seen_planes());
  const Blur blur = Blur::of(job.look.averaged);
  weigh_kernel<<<layers, kPixelThreads, 0, cudaStream_t(stream)>>>(job);
  blur_kernel<<<fog, kPixelThreads, 0, cudaStream_t(stream)>>>(job, blur, 0, 1, false);
  blur_kernel<<<fog, kPixelThreads, 0, cudaStream_t(stream)>>>(job, blur, 1, 2, true);
  look_through_kernel<<<blocks, kPixelThreads, 0, cudaStream_t(stream)>>>(job);
  blur_kernel<<<seen, kPixelThreads, 0, cudaStream_t(stream)>>>(job, blur, 1, 2, false);
  blur_kernel<<<seen, kPixelThreads, 0, cudaStream_t(stream)>>>(job, blur, 2, 0, true);
  finish_surface_kernel<<<blocks, kPixelThreads, 0, cudaStream_t(stream)>>>(job);
  check_launch("surface");
}

void sheet(const Sheet& job, Stream stream) {
  const dim3 blocks(unsigned(blocks_for(job.columns(), kTexelThreads)), unsigned(job.rows()));
  const Blur blur = Blur::of(job.look.blur);
  prepare_kernel<<<blocks, kTexelThreads, 0, cudaStream_t(stream)>>>(job, blur);
  check_launch("sheet: prepare");
  snap_ramps(job, [&](const auto& pass) {
    ramp_kernel<<<blocks, kTexelThreads, 0, cudaStream_t(stream)>>>(job, pass);
    check_launch("sheet: ramps");
  });
  finish_kernel<<<blocks, kTexelThreads, 0, cudaStream_t(stream)>>>(job, blur);
  check_launch("sheet: finish");
}

}  // namespace lfgs::cuda
