// Dropout: a step leaves out a random fraction of the Gaussians, and the others make up for it (Park et al.,
// "DropGaussian", CVPR 2025). So no Gaussian depends on others that it hides.
#pragma once

#include <cstdint>

#include "math/fit/random.h"

namespace lfgs {

constexpr uint32_t kDropoutPurpose = 1;

template <class T>
struct Dropout {
  const T* rates = nullptr;  // [rows] of each step, in 0..1 but 1
  int64_t rows = 0;
  const int64_t* step = nullptr;  // one number; nothing is left out where it is not in 0..rows-1
  uint64_t seed = 0;
  int64_t count = 0;
  T* factors = nullptr;  // [count] of the opacities: 0, or 1 / (1 - rate)
};

// The factors of Gaussians 4 index .. 4 index + 3, of which those beyond the last are nobody's.
template <class T>
LFGS_HD void dropout4(const Dropout<T>& job, int64_t index) {
  const bool has_row = *job.step >= 0 && *job.step < job.rows;
  const T rate = has_row ? job.rates[*job.step] : T(0);
  const RandomStream random{job.seed, uint32_t(*job.step), kDropoutPurpose};
  const Words4 four = random.words(uint64_t(index));
  const uint32_t words[4] = {four.x0, four.x1, four.x2, four.x3};
  for (int k = 0; k < 4; ++k)
    if (4 * index + k < job.count)
      job.factors[4 * index + k] = double(words[k]) * 0x1p-32 < double(rate) ? T(0) : 1 / (1 - rate);
}

}  // namespace lfgs
