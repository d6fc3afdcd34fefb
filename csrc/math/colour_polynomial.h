// The colour of a Gaussian as seen from everywhere along a rig: a polynomial in the normalized offset s in [-1, 1]. The
// fit takes values at Chebyshev nodes to Chebyshev coefficients, and those to powers of s; its backward pass goes back.
#pragma once

#include <cmath>
#include <vector>

#include "base/config.h"
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

// Below, Basis is a ColourBasis or a kernel's copy of its tables, and V is a colour.

// Chebyshev coefficients of the polynomial that is value(s) at the nodes. Loops over coefficients are unrolled on the
// device, where `nodes` is a constant.
template <class V, class Basis, class Value>
LFGS_HD void chebyshev_of_values(const Basis& basis, int nodes, const Value& value, V* chebyshev) {
  LFGS_UNROLL
  for (int k = 0; k < nodes; ++k) chebyshev[k] = V(0);
  LFGS_NO_UNROLL
  for (int j = 0; j < nodes; ++j) {
    const V at_node = value(basis.nodes[j]);
    LFGS_UNROLL
    for (int k = 0; k < nodes; ++k) chebyshev[k] += basis.to_chebyshev[k * nodes + j] * at_node;
  }
}

// The coefficient of s^p in the polynomial of the Chebyshev coefficients up to `kept`. Only those in [first, end) are
// looked at: p and kept + 1 would do, but with constants the loop can be unrolled.
template <class V, class Basis>
LFGS_HD V power_of_chebyshev(const Basis& basis, int nodes, int p, int kept, int first, int end, const V* chebyshev) {
  V power(0);
  LFGS_UNROLL
  for (int k = first; k < end; ++k)
    if (k <= kept) power += basis.to_powers[p * nodes + k] * chebyshev[k];
  return power;
}

// Backward pass of both: from g_powers, [kept + 1, 3], calls visit(s, gradient of the value at s) for every node.
// Colours of order 0 were clamped at zero, so a channel counts only where `colours`, the result of the fit, is above.
// g_chebyshev is memory for kept + 1 colours.
template <class V, class Basis, class G, class T, class Visit>
LFGS_HD void colour_fit_backward(const Basis& basis, int nodes, int kept, const G* g_powers, const T* colours,
                                 V* g_chebyshev, const Visit& visit) {
  using R = typename V::value_type;
  for (int k = 0; k <= kept; ++k) {
    g_chebyshev[k] = V(0);
    for (int p = 0; p <= k; ++p)
      for (int c = 0; c < 3; ++c)
        if (kept || colours[c] > 0) g_chebyshev[k][c] += basis.to_powers[p * nodes + k] * R(g_powers[3 * p + c]);
  }
  for (int j = 0; j < nodes; ++j) {
    V g_value(0);
    for (int k = 0; k <= kept; ++k) g_value += basis.to_chebyshev[k * nodes + j] * g_chebyshev[k];
    visit(basis.nodes[j], g_value);
  }
}

}  // namespace lfgs
