// The step of the optimiser on the device. A block has kGaussians Gaussians. Most of its warps have their harmonics,
// which are read and written four at a time. The other warps have the rest, a thread per Gaussian. All of a block look
// at the gradients first, for a Gaussian with one that cannot be used keeps all of its numbers.
//
// Floor: every number is read with its two moments and its gradient, and written with the moments: 28 bytes. A Gaussian
// with harmonics of degree 3 reads and writes 59 parameters and four activated numbers, 1.68 kB. A million take 0.50 ms
// on an H100 (3.35 TB/s). Arithmetic, about 20 instructions a number and 400 for the noise, is a fifth of that.
#include "cuda/common/launch.h"
#include "cuda/fit/fit.h"

namespace lfgs::cuda {
namespace {

constexpr int kGaussians = 64;
constexpr int kHarmonicThreads = 192, kThreads = kHarmonicThreads + kGaussians;
constexpr int kWide = 4;  // harmonics of a thread side by side

// Four numbers side by side; those beyond `count` are left alone, and read as zero.
struct Four {
  float n[kWide];
};
__device__ inline Four read4(const float* from, int count, bool aligned) {
  Four four{};
  if (aligned && count >= kWide) {
    const float4 v = *reinterpret_cast<const float4*>(from);
    four = {v.x, v.y, v.z, v.w};
  } else {
    for (int k = 0; k < kWide; ++k) four.n[k] = k < count ? from[k] : 0.f;
  }
  return four;
}
__device__ inline void write4(const Four& four, float* to, int count, bool aligned) {
  if (aligned && count >= kWide) {
    *reinterpret_cast<float4*>(to) = make_float4(four.n[0], four.n[1], four.n[2], four.n[3]);
  } else {
    for (int k = 0; k < kWide; ++k)
      if (k < count) to[k] = four.n[k];
  }
}

// The harmonics of a block, `size` numbers of each of its Gaussians: which of them a thread has.
template <int size>
struct Harmonics {
  static constexpr int kRounds = (kGaussians * size / kWide + kHarmonicThreads - 1) / kHarmonicThreads;
  int64_t first;  // number of the block's first harmonic
  int count;      // harmonics of the block

  __device__ Harmonics(int64_t gaussian, int64_t gaussians)
      : first(gaussian * size),
        count(int(gaussians - gaussian < kGaussians ? gaussians - gaussian : int64_t(kGaussians)) * size) {}
  // The thread's place in a round; its numbers are those from there on that are below `count`.
  __device__ int place(int round) const { return (round * kHarmonicThreads + int(threadIdx.x)) * kWide; }
};

// Read the gradients of a thread's harmonics, and mark the Gaussians of which one cannot be used.
template <int size>
__device__ void read_harmonics(const Update<float>& job, const Harmonics<size>& mine, bool aligned, int* bad,
                               Four (&gradients)[Harmonics<size>::kRounds]) {
#pragma unroll
  for (int round = 0; round < Harmonics<size>::kRounds; ++round) {
    const int place = mine.place(round);
    gradients[round] = read4(job.gradients.sh + mine.first + place, mine.count - place, aligned);
#pragma unroll
    for (int k = 0; k < kWide; ++k)
      if (!is_usable(gradients[round].n[k])) bad[(place + k) / size] = 1;
  }
}

template <int size>
__device__ void move_harmonics(const Update<float>& job, const Step<float>& step, const Harmonics<size>& mine,
                               bool aligned, const int* bad, const Four (&gradients)[Harmonics<size>::kRounds]) {
  const float dc = step.sh_rate(0), rest = step.sh_rate(3);
#pragma unroll
  for (int round = 0; round < Harmonics<size>::kRounds; ++round) {
    const int place = mine.place(round), count = mine.count - place;
    if (count <= 0) return;
    const int64_t at = mine.first + place;
    Four values = read4(job.parameters.sh + at, count, aligned), first = read4(job.first.sh + at, count, aligned);
    Four second = read4(job.second.sh + at, count, aligned);
#pragma unroll
    for (int k = 0; k < kWide; ++k) {
      const int gaussian = (place + k) / size;
      if (k >= count || bad[gaussian]) continue;
      const float rate = place + k - gaussian * size < 3 ? dc : rest;
      values.n[k] = step.adam.moved(values.n[k], gradients[round].n[k], rate, first.n[k], second.n[k]);
    }
    write4(values, job.parameters.sh + at, count, aligned);
    write4(first, job.first.sh + at, count, aligned);
    write4(second, job.second.sh + at, count, aligned);
  }
}

__device__ void count_skipped(const Update<float>& job, int64_t gaussians) {
  atomicAdd(reinterpret_cast<unsigned long long*>(job.skipped), static_cast<unsigned long long>(gaussians));
}

// aligned: whether all arrays of harmonics begin at 16 bytes.
template <int size>
__global__ void __launch_bounds__(kThreads) update_kernel(Update<float> job, bool aligned) {
  __shared__ int bad[kGaussians];
  if (!job.has_row()) {
    if (blockIdx.x == 0 && threadIdx.x == 0) count_skipped(job, job.count());
    return;
  }
  const int64_t begin = int64_t(blockIdx.x) * kGaussians;
  const int own = int(threadIdx.x) - kHarmonicThreads;  // whose other parameters the thread has, from 0 on
  const bool has_own = own >= 0 && begin + own < job.count();
  if (own >= 0) bad[own] = 0;
  __syncthreads();
  const Step<float> step(job);
  const Harmonics<size> mine(begin, job.count());
  Four harmonics[Harmonics<size>::kRounds];
  ParameterGradients<float> gradient;
  if (own < 0) {
    read_harmonics<size>(job, mine, aligned, bad, harmonics);
  } else if (has_own) {
    gradient = ParameterGradients<float>(job, step, begin + own);
    if (!gradient.usable()) bad[own] = 1;
  }
  __syncthreads();
  if (own < 0)
    move_harmonics<size>(job, step, mine, aligned, bad, harmonics);
  else if (has_own && bad[own])
    count_skipped(job, 1);
  else if (has_own)
    move_gaussian(job, step, gradient, begin + own);
}

bool is_aligned(const float* address) { return reinterpret_cast<uintptr_t>(address) % sizeof(float4) == 0; }

}  // namespace

void update(const Update<float>& job, Stream stream) {
  if (job.count() == 0) return;
  const auto kernel = job.numbers() == 3    ? update_kernel<3>
                      : job.numbers() == 12 ? update_kernel<12>
                      : job.numbers() == 27 ? update_kernel<27>
                                            : update_kernel<48>;
  const bool aligned = is_aligned(job.gradients.sh) && is_aligned(job.parameters.sh) && is_aligned(job.first.sh) &&
                       is_aligned(job.second.sh);
  kernel<<<unsigned(blocks_for(job.count(), kGaussians)), kThreads, 0, cudaStream_t(stream)>>>(job, aligned);
  check_launch("update");
}

}  // namespace lfgs::cuda
