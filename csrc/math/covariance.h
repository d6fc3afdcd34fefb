// 3D covariance of a Gaussian, factored: Sigma = F F^T with F = R(q) diag(scale) (Kerbl et al. 2023, eq. 6).
#pragma once

#include <glm/glm.hpp>

#include "base/config.h"

namespace lfgs {

// Rotation matrix of a unit quaternion (w, x, y, z); glm matrices are column-major: m[col][row].
template <class R>
LFGS_HD glm::mat<3, 3, R> rotation_matrix(const glm::vec<4, R>& q) {
  R w = q[0], x = q[1], y = q[2], z = q[3];
  return glm::mat<3, 3, R>(1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y), 2 * (x * y - w * z),
                           1 - 2 * (x * x + z * z), 2 * (y * z + w * x), 2 * (x * z + w * y), 2 * (y * z - w * x),
                           1 - 2 * (x * x + y * y));
}

// Gradient of a unit quaternion from the gradient of its rotation matrix.
template <class R>
LFGS_HD glm::vec<4, R> rotation_matrix_backward(const glm::vec<4, R>& q, const glm::mat<3, 3, R>& g) {
  R w = q[0], x = q[1], y = q[2], z = q[3];
  return {
      2 * (x * (g[1][2] - g[2][1]) + y * (g[2][0] - g[0][2]) + z * (g[0][1] - g[1][0])),
      2 * (y * (g[0][1] + g[1][0]) + z * (g[0][2] + g[2][0]) + w * (g[1][2] - g[2][1])) - 4 * x * (g[1][1] + g[2][2]),
      2 * (x * (g[0][1] + g[1][0]) + z * (g[1][2] + g[2][1]) + w * (g[2][0] - g[0][2])) - 4 * y * (g[0][0] + g[2][2]),
      2 * (x * (g[0][2] + g[2][0]) + y * (g[1][2] + g[2][1]) + w * (g[0][1] - g[1][0])) - 4 * z * (g[0][0] + g[1][1])};
}

// A symmetric 3x3 matrix, by its six numbers.
template <class R>
struct Symmetric3 {
  R xx = 0, xy = 0, xz = 0, yy = 0, yz = 0, zz = 0;
};

template <class R>
LFGS_HD Symmetric3<R> times_own_transpose(const glm::mat<3, 3, R>& f) {
  auto dot = [&](int a, int b) { return f[0][a] * f[0][b] + f[1][a] * f[1][b] + f[2][a] * f[2][b]; };
  return {dot(0, 0), dot(0, 1), dot(0, 2), dot(1, 1), dot(1, 2), dot(2, 2)};
}

// Gradient of F from the gradient of the six numbers of F F^T.
template <class R>
LFGS_HD glm::mat<3, 3, R> times_own_transpose_backward(const glm::mat<3, 3, R>& f, const Symmetric3<R>& g) {
  glm::mat<3, 3, R> twice(2 * g.xx, g.xy, g.xz, g.xy, 2 * g.yy, g.yz, g.xz, g.yz, 2 * g.zz);
  return twice * f;
}

}  // namespace lfgs
