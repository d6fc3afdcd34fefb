// The sheet over a photo: a thread has a texel, a block a piece of a row. Three floats a texel go through shared
// memory, so that a warp writes what lies side by side.
#include "cuda/common/check.h"
#include "cuda/photo/photo.h"

namespace lfgs::cuda {
namespace {

constexpr int kThreads = 256;

__global__ void __launch_bounds__(kThreads) prepare_kernel(const __grid_constant__ Sheet job, Blur blur) {
  const int64_t column = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  auto weight = [&](int k) { return blur.weight(k); };
  if (column < job.columns()) prepare_texel(job, blur.reach, weight, blockIdx.y, column);
}

// Write the vectors of a block's first `count` threads.
__device__ void store_vectors(const glm::vec3& mine, int count, float (&shared)[3 * kThreads], float* to) {
  for (int c = 0; c < 3; ++c) shared[3 * threadIdx.x + c] = mine[c];
  __syncthreads();
  for (int k = threadIdx.x; k < 3 * count; k += kThreads) to[k] = shared[k];
  __syncthreads();
}

__global__ void __launch_bounds__(kThreads) finish_kernel(const __grid_constant__ Sheet job, Blur blur) {
  __shared__ float shared[3 * kThreads];
  const int64_t row = blockIdx.y, first = int64_t(blockIdx.x) * kThreads, column = first + threadIdx.x;
  const int64_t texel = row * job.columns() + first;
  const int count = int(min(int64_t(kThreads), job.columns() - first));
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

void sheet(const Sheet& job, Stream stream) {
  const dim3 blocks(unsigned(blocks_for(job.columns(), kThreads)), unsigned(job.rows()));
  const Blur blur = Blur::of(job.look.blur);
  prepare_kernel<<<blocks, kThreads, 0, cudaStream_t(stream)>>>(job, blur);
  check_launch("sheet: prepare");
  finish_kernel<<<blocks, kThreads, 0, cudaStream_t(stream)>>>(job, blur);
  check_launch("sheet: finish");
}

}  // namespace lfgs::cuda
