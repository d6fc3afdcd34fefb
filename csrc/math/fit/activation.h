// How the parameters that are optimised become those that are drawn, and the limits that keep both finite: scales are
// exp(log_scale), opacities are sigmoid(logit) (Kerbl et al. 2023, section 5).
#pragma once

#include <cmath>

#include "base/config.h"

namespace lfgs {

// exp(-20) .. exp(20) is 2e-9 .. 5e8 scene units: beyond what float32 tells from zero beside a mean of 1, and beyond
// any scene.
constexpr double kMostLogScale = 20;
// sigmoid(15) = 1 - 3e-7 is the largest that float32 still tells from 1 by a few steps: log(1 - opacity) stays finite.
constexpr double kMostLogit = 15;

template <class R>
LFGS_HD R clamped(R value, R most) {
  return value > most ? most : value < -most ? -most : value;
}

// 0 for very negative values, without overflow on the way.
template <class R>
LFGS_HD R sigmoid(R value) {
  return 1 / (1 + std::exp(-clamped(value, R(80))));
}

}  // namespace lfgs
