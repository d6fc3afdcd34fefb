// Random numbers without a state, and dropout. Philox4x32-10 turns a counter and a key into four words (Salmon et al.,
// "Parallel random numbers: as easy as 1, 2, 3", SC 2011). A number is a function of its purpose, step and index. So
// every run, every device and every number of threads draws the same numbers, and checkpoints store no generator.
#pragma once

#include <cstdint>
#include <cmath>

#include "base/config.h"
#include "math/constants.h"

namespace lfgs {

struct Words4 {
  uint32_t x0, x1, x2, x3;
};

// The generator itself: ten rounds of two multiplications.
LFGS_HD Words4 philox4x32(Words4 counter, uint32_t key0, uint32_t key1) {
  Words4 c = counter;
  LFGS_UNROLL
  for (int round = 0; round < 10; ++round) {
    const uint64_t a = uint64_t(0xD2511F53u) * c.x0, b = uint64_t(0xCD9E8D57u) * c.x2;
    c = {uint32_t(b >> 32) ^ c.x1 ^ key0, uint32_t(b), uint32_t(a >> 32) ^ c.x3 ^ key1, uint32_t(a)};
    key0 += 0x9E3779B9u, key1 += 0xBB67AE85u;
  }
  return c;
}

// The purpose and step of random numbers. Streams of different purposes or steps are independent.
struct RandomStream {
  uint64_t seed;
  uint32_t step, purpose;

  // The four words of an index.
  LFGS_HD Words4 words(uint64_t index) const {
    return philox4x32({uint32_t(index), uint32_t(index >> 32), step, purpose}, uint32_t(seed), uint32_t(seed >> 32));
  }
};
constexpr uint32_t kNoisePurpose = 0;  // of position_noise()

// Two words as a number in [0, 1), of 53 bits.
LFGS_HD double to_uniform(uint32_t high, uint32_t low) { return double((uint64_t(high) << 32 | low) >> 11) * 0x1p-53; }

// A pair of independent normal numbers, none larger than 6.8: the first word becomes a number in (0, 1].
template <class R>
LFGS_HD void normal_pair(uint32_t word0, uint32_t word1, R& first, R& second) {
  const R radius = std::sqrt(R(-2) * std::log((R(word0) + R(0.5)) * R(0x1p-32)));
  const R angle = R(word1) * R(2 * kPi * 0x1p-32);
  first = radius * std::cos(angle), second = radius * std::sin(angle);
}

// Four normal numbers of an index.
template <class R>
LFGS_HD void normals4(const RandomStream& stream, uint64_t index, R (&out)[4]) {
  const Words4 words = stream.words(index);
  normal_pair(words.x0, words.x1, out[0], out[1]);
  normal_pair(words.x2, words.x3, out[2], out[3]);
}

constexpr uint32_t kDropoutPurpose = 1;

// Dropout: a step leaves out a random fraction of the Gaussians, and raises the opacities of the others instead (Park
// et al., "DropGaussian", CVPR 2025). So no Gaussian depends on others that it hides.
template <class T>
struct Dropout {
  const T* rates = nullptr;  // [rows] of each step, in 0..1 but 1
  int64_t rows = 0;
  const int64_t* step = nullptr;  // one number; nothing is left out where it is not in 0..rows-1
  uint64_t seed = 0;
  int64_t count = 0;
  T* factors = nullptr;  // [count] of the opacities: 0, or 1 / (1 - rate)
};

// Write the factors of the Gaussians 4 index .. 4 index + 3, as far as they exist.
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
