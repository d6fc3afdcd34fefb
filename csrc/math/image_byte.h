// How a colour becomes a byte of an image.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>

namespace lfgs {

// round(255 clamp(c, 0, 1)), ties to even (the rounding mode that a process starts with).
template <class T>
uint8_t to_byte(T c) {
  return uint8_t(std::nearbyint(std::clamp(c, T(0), T(1)) * 255));
}

}  // namespace lfgs
