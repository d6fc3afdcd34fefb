// A step of Adam for one number, with its corrections for moments that begin at zero. See Kingma & Ba, "Adam: a method
// for stochastic optimization", ICLR 2015, algorithm 1.
#pragma once

#include <cmath>

#include "base/config.h"

namespace lfgs {

// Constants of all steps of a run.
struct AdamDecay {
  double first = 0.9, second = 0.999;  // beta1, beta2
  double epsilon = 1e-15;              // added to the root of the second moment
};

// The numbers of one step that do not depend on the field. With c1 = 1 - beta1^t and c2 = 1 - beta2^t a number moves by
// -(rate / c1) m / (sqrt(v / c2) + epsilon).
template <class R>
struct AdamStep {
  R keep_first, take_first, keep_second, take_second;  // beta1, 1 - beta1, beta2, 1 - beta2
  R epsilon, inverse_root_correction, inverse_correction;

  LFGS_HD AdamStep(const AdamDecay& decay, R first_correction, R second_correction)
      : keep_first(R(decay.first)),
        take_first(R(1 - decay.first)),
        keep_second(R(decay.second)),
        take_second(R(1 - decay.second)),
        epsilon(R(decay.epsilon)),
        inverse_root_correction(1 / std::sqrt(second_correction)),
        inverse_correction(1 / first_correction) {}

  // Move a number against its gradient, and renew its moments. rate_over_c1: the rate of its field times
  // inverse_correction.
  LFGS_HD R moved(R value, R gradient, R rate_over_c1, R& first, R& second) const {
    first = keep_first * first + take_first * gradient;
    second = keep_second * second + take_second * gradient * gradient;
    return value - rate_over_c1 * first / (std::sqrt(second) * inverse_root_correction + epsilon);
  }
};

// Gradients that are no numbers, or so large that their square is none in float32, would spoil the moments for good.
template <class R>
LFGS_HD bool is_usable(R gradient) {
  return std::abs(gradient) <= R(1e18);  // false for NaN
}

}  // namespace lfgs
