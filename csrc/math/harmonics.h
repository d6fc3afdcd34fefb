// Real spherical harmonics to degree 3, with the signs and constants of 3D Gaussian Splatting (Kerbl et al. 2023).
#pragma once

#include <glm/glm.hpp>

#include <cmath>

#include "base/config.h"

namespace lfgs {

constexpr int kMaxShCount = 16;
constexpr double kConstantHarmonic = 0.28209479177387814;  // of degree 0, 1 / (2 sqrt(pi))

// Write the values of the harmonics at the unit direction d: basis[k], k < (degree + 1)^2.
template <class R>
LFGS_HD void sh_basis(int degree, const glm::vec<3, R>& d, R* basis) {
  R x = d.x, y = d.y, z = d.z;
  basis[0] = R(kConstantHarmonic);
  if (degree < 1) return;
  const R k1(0.4886025119029199);
  basis[1] = -k1 * y, basis[2] = k1 * z, basis[3] = -k1 * x;
  if (degree < 2) return;
  const R k2(1.0925484305920792);
  basis[4] = k2 * x * y, basis[5] = -k2 * y * z, basis[7] = -k2 * x * z;
  basis[6] = R(0.31539156525252005) * (2 * z * z - x * x - y * y);
  basis[8] = k2 / 2 * (x * x - y * y);
  if (degree < 3) return;
  const R k3(0.5900435899266435), k31(0.4570457994644658);
  basis[9] = -k3 * y * (3 * x * x - y * y);
  basis[10] = R(2.890611442640554) * x * y * z;
  basis[11] = -k31 * y * (4 * z * z - x * x - y * y);
  basis[12] = R(0.3731763325901154) * z * (2 * z * z - 3 * x * x - 3 * y * y);
  basis[13] = -k31 * x * (4 * z * z - x * x - y * y);
  basis[14] = R(1.445305721320277) * z * (x * x - y * y);
  basis[15] = -k3 * x * (x * x - 3 * y * y);
}

// Gradient of the direction d from the gradients of the values that sh_basis writes.
template <class R>
LFGS_HD glm::vec<3, R> sh_basis_backward(int degree, const glm::vec<3, R>& d, const R* g) {
  R x = d.x, y = d.y, z = d.z;
  glm::vec<3, R> out(0);
  if (degree < 1) return out;
  const R k1(0.4886025119029199);
  out += glm::vec<3, R>(-k1 * g[3], -k1 * g[1], k1 * g[2]);
  if (degree < 2) return out;
  const R k2(1.0925484305920792), k20(0.31539156525252005);
  out.x += k2 * (y * g[4] - z * g[7] + x * g[8]) - 2 * k20 * x * g[6];
  out.y += k2 * (x * g[4] - z * g[5] - y * g[8]) - 2 * k20 * y * g[6];
  out.z += -k2 * (y * g[5] + x * g[7]) + 4 * k20 * z * g[6];
  if (degree < 3) return out;
  const R k3(0.5900435899266435), k31(0.4570457994644658), k30(0.3731763325901154), k32(1.445305721320277);
  R xx = x * x, yy = y * y, zz = z * z;
  out.x += -6 * k3 * x * y * g[9] + 2 * k32 * y * z * g[10] + 2 * k31 * x * y * g[11] - 6 * k30 * x * z * g[12] -
           k31 * (4 * zz - 3 * xx - yy) * g[13] + 2 * k32 * x * z * g[14] - 3 * k3 * (xx - yy) * g[15];
  out.y += -3 * k3 * (xx - yy) * g[9] + 2 * k32 * x * z * g[10] - k31 * (4 * zz - xx - 3 * yy) * g[11] -
           6 * k30 * y * z * g[12] + 2 * k31 * x * y * g[13] - 2 * k32 * y * z * g[14] + 6 * k3 * x * y * g[15];
  out.z += 2 * k32 * x * y * g[10] - 8 * k31 * y * z * g[11] + k30 * (6 * zz - 3 * xx - 3 * yy) * g[12] -
           8 * k31 * x * z * g[13] + k32 * (xx - yy) * g[14];
  return out;
}

// The colour seen in the unit direction d, 0.5 + sum of harmonics, before it is clamped at zero; sh is [K, 3].
template <class R, class T>
LFGS_HD glm::vec<3, R> sh_colour_towards(int degree, const T* sh, const glm::vec<3, R>& d) {
  R basis[kMaxShCount];
  sh_basis(degree, d, basis);
  glm::vec<3, R> colour(R(0.5));
  LFGS_UNROLL
  for (int k = 0; k < kMaxShCount; ++k) {  // to a fixed end, so that a compiler may unroll it
    if (k >= (degree + 1) * (degree + 1)) break;
    for (int c = 0; c < 3; ++c) colour[c] += basis[k] * R(sh[3 * k + c]);
  }
  return colour;
}

// The same, seen from `eye`.
template <class R, class T>
LFGS_HD glm::vec<3, R> sh_colour(int degree, const T* sh, const glm::vec<3, R>& mean, const glm::vec<3, R>& eye) {
  const glm::vec<3, R> to_mean = mean - eye;
  const R length = glm::length(to_mean);
  return sh_colour_towards(degree, sh, length > 0 ? to_mean / length : glm::vec<3, R>(0, 0, 1));
}

// Write the gradients of the coefficients to g_sh, which may be sh itself, or add them if kAdd. Return the gradient
// of the direction d.
template <bool kAdd = true, class R, class T, class G>
LFGS_HD glm::vec<3, R> sh_colour_towards_backward(int degree, const T* sh, const glm::vec<3, R>& d,
                                                  const glm::vec<3, R>& g_colour, G* g_sh) {
  R basis[kMaxShCount], g_basis[kMaxShCount] = {};
  sh_basis(degree, d, basis);
  // To a fixed end, so that a compiler may unroll it and keep the bases in registers
  const int count = (degree + 1) * (degree + 1);
  LFGS_UNROLL
  for (int k = 0; k < kMaxShCount; ++k) {
    if (k >= count) break;
    for (int c = 0; c < 3; ++c) {
      g_basis[k] += R(sh[3 * k + c]) * g_colour[c];
      const G gradient = G(basis[k] * g_colour[c]);
      g_sh[3 * k + c] = kAdd ? g_sh[3 * k + c] + gradient : gradient;
    }
  }
  return sh_basis_backward(degree, d, g_basis);
}

// The same for the colour seen from `eye`. Return the gradient of the mean; the eye's gradient is minus this.
template <bool kAdd = true, class R, class T, class G>
LFGS_HD glm::vec<3, R> sh_colour_backward(int degree, const T* sh, const glm::vec<3, R>& mean,
                                          const glm::vec<3, R>& eye, const glm::vec<3, R>& g_colour, G* g_sh) {
  const glm::vec<3, R> to_mean = mean - eye;
  const R length = glm::length(to_mean);
  const bool defined = length > 0;
  const glm::vec<3, R> d = defined ? to_mean / length : glm::vec<3, R>(0, 0, 1);
  const glm::vec<3, R> g_d = sh_colour_towards_backward<kAdd>(degree, sh, d, g_colour, g_sh);
  return defined ? (g_d - glm::dot(g_d, d) * d) / length : glm::vec<3, R>(0);
}

}  // namespace lfgs
