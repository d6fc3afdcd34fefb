// Arrays of random numbers. A work item has a fixed piece of them, of whole indices of the stream.
#include <algorithm>

#include "base/parallel.h"
#include "math/fit/random.h"
#include "stages/fit.h"

namespace lfgs {
namespace {
constexpr int64_t kIndices = 4096;  // of a work item
}

void uniforms(const RandomStream& stream, int64_t count, double* out, int threads) {
  parallel_for_chunks(count, 2 * kIndices, threads, [&](int64_t begin, int64_t end, int) {
    for (int64_t i = begin; i < end; i += 2) {
      const Words4 words = stream.words(uint64_t(i) / 2);
      out[i] = to_uniform(words.x0, words.x1);
      if (i + 1 < end) out[i + 1] = to_uniform(words.x2, words.x3);
    }
  });
}

template <class T>
void normals(const RandomStream& stream, int64_t count, T* out, int threads) {
  parallel_for_chunks(count, 4 * kIndices, threads, [&](int64_t begin, int64_t end, int) {
    for (int64_t i = begin; i < end; i += 4) {
      T four[4];
      normals4(stream, uint64_t(i) / 4, four);
      std::copy_n(four, std::min<int64_t>(4, end - i), out + i);
    }
  });
}

template <class T>
void dropout(const Dropout<T>& job, int threads) {
  parallel_for_chunks((job.count + 3) / 4, kIndices, threads, [&](int64_t begin, int64_t end, int) {
    for (int64_t index = begin; index < end; ++index) dropout4(job, index);
  });
}

template void dropout<float>(const Dropout<float>&, int);
template void dropout<double>(const Dropout<double>&, int);
template void normals<float>(const RandomStream&, int64_t, float*, int);
template void normals<double>(const RandomStream&, int64_t, double*, int);

}  // namespace lfgs
