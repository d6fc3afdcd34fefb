// The step of the optimiser. A work item is a chunk of Gaussians; nothing of one depends on another. The harmonics,
// most of the numbers, are moved by loops that the compiler turns into vectors, in single precision once for every
// instruction set.
#include <algorithm>
#include <vector>

#include "base/parallel.h"
#include "stages/fit.h"

#undef HWY_TARGET_INCLUDE
#define HWY_TARGET_INCLUDE "cpu/fit/update.cpp"
#include "hwy/foreach_target.h"  // IWYU pragma: keep
#include "hwy/highway.h"

HWY_BEFORE_NAMESPACE();
namespace lfgs {
namespace HWY_NAMESPACE {

// Whether all of `size` gradients can be used.
template <class T>
HWY_ATTR bool all_usable(const T* gradients, int size) {
  int bad = 0;
  for (int k = 0; k < size; ++k) bad |= !is_usable(gradients[k]);
  return bad == 0;
}

// Move the harmonics of a Gaussian; rates [size].
template <class T>
HWY_ATTR void move_harmonics(const AdamStep<T>& adam, int size, const T* rates, const T* __restrict gradients,
                             T* __restrict values, T* __restrict first, T* __restrict second) {
  for (int k = 0; k < size; ++k) values[k] = adam.moved(values[k], gradients[k], rates[k], first[k], second[k]);
}

// Gaussians [begin, end). Return how many were skipped.
template <class T>
HWY_ATTR int64_t move_chunk(const Update<T>& job, int64_t begin, int64_t end) {
  const Step<T> step(job);
  const int size = job.numbers();
  T rates[3 * 16];
  for (int k = 0; k < size; ++k) rates[k] = step.sh_rate(k);
  int64_t skipped = 0;
  for (int64_t i = begin; i < end; ++i) {
    const ParameterGradients<T> gradient(job, step, i);
    const int64_t at = i * size;
    if (!gradient.usable() || !all_usable(job.gradients.sh + at, size)) {
      ++skipped;
      continue;
    }
    move_harmonics(step.adam, size, rates, job.gradients.sh + at, job.parameters.sh + at, job.first.sh + at,
                   job.second.sh + at);
    move_gaussian(job, step, gradient, i);
  }
  return skipped;
}

int64_t move_chunk_f32(const Update<float>& job, int64_t begin, int64_t end) { return move_chunk(job, begin, end); }

}  // namespace HWY_NAMESPACE
}  // namespace lfgs
HWY_AFTER_NAMESPACE();

#if HWY_ONCE
namespace lfgs {
namespace {

constexpr int64_t kChunk = 1024;  // Gaussians of a work item

HWY_EXPORT(move_chunk_f32);
int64_t move(const Update<float>& job, int64_t begin, int64_t end) {
  return HWY_DYNAMIC_DISPATCH(move_chunk_f32)(job, begin, end);
}
int64_t move(const Update<double>& job, int64_t begin, int64_t end) {
  return HWY_STATIC_DISPATCH(move_chunk)(job, begin, end);
}

}  // namespace

template <class T>
void update(const Update<T>& job, int threads) {
  if (!job.has_row()) {
    *job.skipped += job.count();
    return;
  }
  std::vector<int64_t> skipped((job.count() + kChunk - 1) / kChunk);
  parallel_for_chunks(job.count(), kChunk, threads,
                      [&](int64_t begin, int64_t end, int) { skipped[begin / kChunk] = move(job, begin, end); });
  for (int64_t of_chunk : skipped) *job.skipped += of_chunk;
}

template void update<float>(const Update<float>&, int);
template void update<double>(const Update<double>&, int);

}  // namespace lfgs
#endif
