// Colour of a Gaussian as seen from everywhere along a rig: a polynomial in the normalized offset s in [-1, 1], from
// its values at Chebyshev nodes.
#pragma once

#include <cmath>
#include <vector>

#include "base/error.h"
#include "math/constants.h"

namespace lfgs {

constexpr int kMaxColourOrder = 16;

// Linear maps between values at the n = order + 1 nodes, Chebyshev coefficients and powers of s; all n x n, row-major.
struct ColourBasis {
  int order;
  std::vector<double> nodes;         // cos(pi (j + 1/2) / n)
  std::vector<double> to_chebyshev;  // [coefficient, node]
  std::vector<double> to_powers;     // [power, Chebyshev coefficient]

  explicit ColourBasis(int order_) : order(order_) {
    require(order >= 0 && order <= kMaxColourOrder, "colour order must be 0..16, not " + std::to_string(order));
    const int n = order + 1;
    nodes.resize(n), to_chebyshev.assign(n * n, 0), to_powers.assign(n * n, 0);
    for (int j = 0; j < n; ++j) nodes[j] = n == 1 ? 0 : std::cos(kPi * (j + 0.5) / n);
    for (int k = 0; k < n; ++k)
      for (int j = 0; j < n; ++j) to_chebyshev[k * n + j] = (k ? 2.0 : 1.0) / n * std::cos(kPi * k * (j + 0.5) / n);

    // T_0 = 1, T_1 = s, T_k = 2 s T_(k-1) - T_(k-2)
    auto power = [&](int p, int k) -> double& { return to_powers[p * n + k]; };
    power(0, 0) = 1;
    if (n > 1) power(1, 1) = 1;
    for (int k = 2; k < n; ++k)
      for (int p = 0; p <= k; ++p) power(p, k) = (p ? 2 * power(p - 1, k - 1) : 0) - power(p, k - 2);
  }
};

}  // namespace lfgs
