// Random numbers without a state. Philox4x32-10 turns a counter and a key into four words (Salmon et al., "Parallel
// random numbers: as easy as 1, 2, 3", SC 2011). A number is a function of its purpose, step and index. So every run,
// every device and every number of threads draws the same numbers, and checkpoints store no generator.
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

// What random numbers are drawn for: those of different purposes or steps have nothing to do with each other.
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

}  // namespace lfgs
