// Keeps gradients finite that their number type cannot hold: the gradient of a quaternion grows without limit as its
// length nears zero.
#pragma once

#include <limits>

#include "base/config.h"

namespace lfgs {

// The nearest finite number of type T; NaN stays NaN.
template <class T, class R>
LFGS_HD T saturated(R value) {
  constexpr R kLargest = R(std::numeric_limits<T>::max());
  return T(value > kLargest ? kLargest : value < -kLargest ? -kLargest : value);
}

}  // namespace lfgs
