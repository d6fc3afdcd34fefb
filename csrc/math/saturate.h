// Keep gradients finite that their number type cannot hold: the gradient of a quaternion grows without limit as its
// length nears zero.
#pragma once

#include <limits>
#include <algorithm>
#include <cmath>
#include <cstdint>

#include "base/config.h"

namespace lfgs {

// The nearest finite number of type T; NaN stays NaN.
template <class T, class R>
LFGS_HD T saturated(R value) {
  constexpr R kLargest = R(std::numeric_limits<T>::max());
  return T(value > kLargest ? kLargest : value < -kLargest ? -kLargest : value);
}

// round(255 clamp(c, 0, 1)), ties to even (the rounding mode that a process starts with).
template <class T>
uint8_t to_byte(T c) {
  return uint8_t(std::nearbyint(std::clamp(c, T(0), T(1)) * 255));
}

}  // namespace lfgs
