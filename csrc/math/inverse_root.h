// S(s)^(-1/2) as a parabola over the rig, which saves every sample a division.
#pragma once

#include <cmath>

#include "base/config.h"
#include "math/projection.h"

namespace lfgs {

constexpr double kMostRootError = 4e-5;  // relative; alpha errs by less than 0.74 of it, which keeps 80 dB at 8 bits

// S^(-1/2) ~ r0 + r1 s + r2 s^2 for s in [-1, 1]. With S = S0 (1 + a1 s + a2 s^2) it is a power series up to s^4. The
// nearest polynomials of lower order, 3/4 s and s^2 - 1/8, replace s^3 and s^4 (Chebyshev's economization).
template <class T>
struct InverseRoot {
  T r0 = 0, r1 = 0, r2 = 0;
  T error = 1;  // about the largest relative error

  InverseRoot() = default;
  LFGS_HD explicit InverseRoot(const Splat<T>& s) {
    const T inverse = 1 / s.S0, root = std::sqrt(inverse), a1 = s.S1 * inverse, a2 = s.S2 * inverse, square = a1 * a1;
    const T p1 = T(-0.5) * a1, p2 = T(0.375) * square - T(0.5) * a2;
    const T p3 = a1 * (T(0.75) * a2 - T(0.3125) * square);
    const T p4 = T(0.2734375) * square * square - T(0.9375) * square * a2 + T(0.375) * a2 * a2;
    r0 = root * (1 - p4 / 8), r1 = root * (p1 + T(0.75) * p3), r2 = root * (p2 + p4);
    error = std::fabs(p3) / 4 + std::fabs(p4) / 8;
    // Where S varies much the terms left out are too large for this estimate
    if (!(std::fabs(a1) + std::fabs(a2) <= T(0.5))) error = 1;
  }
};

}  // namespace lfgs
