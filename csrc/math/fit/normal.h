// Normal numbers of mean 0 and variance 1 from random words (Box & Muller, "A note on the generation of random normal
// deviates", 1958).
#pragma once

#include <cmath>

#include "math/constants.h"
#include "math/fit/philox.h"

namespace lfgs {

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
