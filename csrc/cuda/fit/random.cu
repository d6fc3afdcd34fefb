// Arrays of random numbers on the device: a thread has an index of the stream.
#include "cuda/common/launch.h"
#include "cuda/fit/fit.h"
#include "math/fit/random.h"

namespace lfgs::cuda {
namespace {

constexpr int kThreads = 256;

__device__ int64_t own_index() { return int64_t(blockIdx.x) * kThreads + threadIdx.x; }

__global__ void uniforms_kernel(RandomStream random, int64_t count, double* out) {
  const int64_t i = own_index();
  if (2 * i >= count) return;
  const Words4 words = random.words(uint64_t(i));
  out[2 * i] = to_uniform(words.x0, words.x1);
  if (2 * i + 1 < count) out[2 * i + 1] = to_uniform(words.x2, words.x3);
}

__global__ void normals_kernel(RandomStream random, int64_t count, float* out) {
  const int64_t i = own_index();
  if (4 * i >= count) return;
  float four[4];
  normals4(random, uint64_t(i), four);
  for (int k = 0; k < 4; ++k)
    if (4 * i + k < count) out[4 * i + k] = four[k];
}

__global__ void dropout_kernel(Dropout<float> job) {
  const int64_t i = own_index();
  if (4 * i < job.count) dropout4(job, i);
}

}  // namespace

void uniforms(const RandomStream& random, int64_t count, double* out, Stream stream) {
  if (count == 0) return;
  uniforms_kernel<<<unsigned(blocks_for(count, 2 * kThreads)), kThreads, 0, cudaStream_t(stream)>>>(random, count, out);
  check_launch("uniforms");
}

void normals(const RandomStream& random, int64_t count, float* out, Stream stream) {
  if (count == 0) return;
  normals_kernel<<<unsigned(blocks_for(count, 4 * kThreads)), kThreads, 0, cudaStream_t(stream)>>>(random, count, out);
  check_launch("normals");
}

void dropout(const Dropout<float>& job, Stream stream) {
  if (job.count == 0) return;
  dropout_kernel<<<unsigned(blocks_for(job.count, 4 * kThreads)), kThreads, 0, cudaStream_t(stream)>>>(job);
  check_launch("dropout");
}

}  // namespace lfgs::cuda
