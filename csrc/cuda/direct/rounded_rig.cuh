// Arguments that the kernels for panels take by value: the rig, exact and in float, and the colour basis.
#pragma once

#include "math/colour_polynomial.h"
#include "scene/camera.h"

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

inline Camera<float> rounded(const Camera<double>& rig) {
  Camera<float> camera;
  camera.rotation = glm::mat3(rig.rotation), camera.translation = glm::vec3(rig.translation);
  camera.fx = float(rig.fx), camera.fy = float(rig.fy), camera.cx = float(rig.cx), camera.cy = float(rig.cy);
  camera.x_low = float(rig.x_low), camera.x_high = float(rig.x_high);
  camera.y_low = float(rig.y_low), camera.y_high = float(rig.y_high);
  camera.offset = float(rig.offset), camera.sweep = float(rig.sweep);
  camera.inverse_zero_depth = float(rig.inverse_zero_depth);
  return camera;
}

// A rig as it is, and rounded to float for whatever does not need its last digits.
struct RoundedRig {
  Camera<double> exact;
  Camera<float> rounded;

  explicit RoundedRig(const Camera<double>& rig) : exact(rig), rounded(cuda::rounded(rig)) {}
};

}  // namespace lfgs::cuda
