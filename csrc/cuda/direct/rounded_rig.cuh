// What the kernels of the lens sensor take by value: the rig, exact and in float, and the colour basis.
#pragma once

#include "math/colour_polynomial.h"
#include "scene/view.h"

namespace lfgs::cuda {

// A ColourBasis in a form that fits the arguments of a kernel, in float.
struct BasisTable {
  int order;
  float nodes[kMaxColourOrder + 1];
  float to_chebyshev[(kMaxColourOrder + 1) * (kMaxColourOrder + 1)];
  float to_powers[(kMaxColourOrder + 1) * (kMaxColourOrder + 1)];

  explicit BasisTable(const ColourBasis& basis) : order(basis.order) {
    for (size_t i = 0; i < basis.nodes.size(); ++i) nodes[i] = float(basis.nodes[i]);
    for (size_t i = 0; i < basis.to_powers.size(); ++i)
      to_chebyshev[i] = float(basis.to_chebyshev[i]), to_powers[i] = float(basis.to_powers[i]);
  }
};

inline View<float> rounded(const View<double>& rig) {
  View<float> view;
  view.rotation = glm::mat3(rig.rotation), view.translation = glm::vec3(rig.translation);
  view.fx = float(rig.fx), view.fy = float(rig.fy), view.cx = float(rig.cx), view.cy = float(rig.cy);
  view.x_low = float(rig.x_low), view.x_high = float(rig.x_high);
  view.y_low = float(rig.y_low), view.y_high = float(rig.y_high);
  view.offset = float(rig.offset), view.sweep = float(rig.sweep);
  view.inverse_zero_depth = float(rig.inverse_zero_depth);
  return view;
}

// A rig as it is, and rounded to float for whatever does not need its last digits.
struct Rig {
  View<double> exact;
  View<float> rounded;

  explicit Rig(const View<double>& rig) : exact(rig), rounded(cuda::rounded(rig)) {}
};

}  // namespace lfgs::cuda
