// EWA projection of one Gaussian by a camera, or by all cameras of an off-axis rig at once. A Shape and a Camera become
// a Splat. The backward pass takes the gradient of the Splat back to both.
//
// For the camera at offset s, the projected mean is u(s) = u0 + s du, and the projected covariance (Zwicker et al.
// 2001) is xx(s), quadratic, xy(s), linear, and yy, constant. A splat stores them in conditional form. log2(e)/2 is
// folded into tau and 1/S.
//   -log2 weight = tau dy^2 + (px - m(s))^2 / S(s),   dy = py - v0,
//   m(s) = u0 + c0 dy + s (du + c1 dy),   S(s) = S0 + S1 s + S2 s^2.
#pragma once

#include <glm/glm.hpp>

#include <cmath>

#include "math/compensation.h"
#include "math/constants.h"
#include "math/covariance.h"
#include "scene/camera.h"
#include "scene/gaussians.h"

namespace lfgs {

// A projected Gaussian, in pixels; the formula is above.
template <class T>
struct Splat {
  T u0, du, v0, log2_opacity;
  T S0, S1, S2, tau;
  T c0, c1;
  T reach_y;  // half height of the footprint in rows; negative: not drawn
  T depth;    // camera-space z
};
constexpr int kSplatFields = 12, kSplatReachIndex = 10;  // how many numbers a Splat has, and which of them is reach_y

template <class T, class R>
LFGS_HD Splat<T> splat_cast(const Splat<R>& s) {
  return {T(s.u0), T(s.du),  T(s.v0), T(s.log2_opacity), T(s.S0),      T(s.S1),
          T(s.S2), T(s.tau), T(s.c0), T(s.c1),           T(s.reach_y), T(s.depth)};
}

// One Gaussian as projection reads it.
template <class R>
struct Shape {
  glm::vec<3, R> mean;
  glm::vec<4, R> quaternion;  // any length but zero
  glm::vec<3, R> scale;
  R opacity;
};

template <class R, class T>
LFGS_HD Shape<R> load_shape(const Gaussians<const T>& g, int64_t i) {
  const T *m = g.means + 3 * i, *q = g.quaternions + 4 * i, *s = g.scales + 3 * i;
  return {{m[0], m[1], m[2]}, {q[0], q[1], q[2], q[3]}, {s[0], s[1], s[2]}, R(g.opacities[i])};
}

// Largest component of a quaternion, by which it is divided before squares that might underflow or overflow.
template <class R>
LFGS_HD R largest_component(const glm::vec<4, R>& quaternion) {
  const glm::vec<4, R> q = glm::abs(quaternion);
  return glm::max(glm::max(q.x, q.y), glm::max(q.z, q.w));
}

// Gradient of a quaternion from the gradient of its unit quaternion. The shorter the quaternion, the larger its
// gradient, up to infinity; but zero stays zero.
LFGS_HD glm::dvec4 quaternion_gradient(const glm::dvec4& quaternion, const glm::dvec4& g_unit) {
  if (g_unit == glm::dvec4(0)) return g_unit;
  const double largest = largest_component(quaternion);
  return g_unit / largest / glm::length(quaternion / largest);
}

template <class R>
struct CameraGradient {
  glm::mat<3, 3, R> rotation{R(0)};
  glm::vec<3, R> translation{R(0)};
};

// The numbers of a Camera that are no pose: its intrinsics and limits and, of a rig, three more.
enum Optic : int {
  kFx,
  kFy,
  kCx,
  kCy,
  kXLow,
  kXHigh,
  kYLow,
  kYHigh,
  kOffset,
  kCameraOptics,
  kSweep = kCameraOptics,
  kInverseZeroDepth,
  kAperture,
  kRigOptics
};
template <class R>
struct OpticsGradient {
  R numbers[kRigOptics] = {};

  LFGS_HD R& operator[](Optic optic) { return numbers[optic]; }
  OpticsGradient& operator+=(const OpticsGradient& other) {
    for (int k = 0; k < kRigOptics; ++k) numbers[k] += other.numbers[k];
    return *this;
  }
};

// A Gaussian in the axes of a camera, whatever the camera's model, and its backward pass.
template <class R>
struct Body {
  glm::vec<3, R> t;                // mean in camera axes
  glm::vec<4, R> unit;             // normalized quaternion
  glm::mat<3, 3, R> turn, factor;  // camera-from-local rotation; the same times the scales
  bool drawn;

  // Nothing but the mean and whether it may be seen, at the depth that `depth_of` finds.
  template <class Depth>
  LFGS_HD Body(const Camera<R>& camera, const Shape<R>& shape, const Depth& depth_of) {
    t = camera.rotation * shape.mean + camera.translation;
    const glm::vec<4, R> direction = shape.quaternion / largest_component(shape.quaternion);  // NaN where it is zero
    drawn = depth_of(t) >= R(kNearDepth) && shape.opacity * 255 >= 1 && glm::length(direction) > 0;
    if (!drawn) return;
    unit = glm::normalize(direction);
    turn = camera.rotation * rotation_matrix(unit);
    factor = turn;
    for (int k = 0; k < 3; ++k) factor[k] *= shape.scale[k];
  }

  // Add the gradients that follow from those of `factor` and of the mean in camera axes. What out.quaternion gets is
  // the gradient of the unit quaternion: a sum of it over cameras may cancel where quaternion_gradient would be
  // infinite.
  LFGS_HD void backward(const Camera<R>& camera, const Shape<R>& shape, const glm::mat<3, 3, R>& g_factor,
                        const glm::vec<3, R>& g_t, Shape<R>& out, CameraGradient<R>& camera_out) const {
    glm::mat<3, 3, R> g_turn = g_factor;
    for (int k = 0; k < 3; ++k) {
      out.scale[k] += glm::dot(g_turn[k], turn[k]);
      g_turn[k] *= shape.scale[k];
    }
    glm::mat<3, 3, R> local = rotation_matrix(unit);
    glm::vec<4, R> g_unit = rotation_matrix_backward(unit, glm::transpose(camera.rotation) * g_turn);
    out.quaternion += g_unit - glm::dot(g_unit, unit) * unit;
    camera_out.rotation += g_turn * glm::transpose(local);

    out.mean += glm::transpose(camera.rotation) * g_t;
    camera_out.rotation += glm::outerProduct(g_t, shape.mean);
    camera_out.translation += g_t;
  }
};

// Intermediate values of the projection and its backward pass. To compute them again for the backward pass is cheaper
// than to store them.
template <class R>
struct Projection : Body<R> {
  using Body<R>::t, Body<R>::factor, Body<R>::drawn;
  Symmetric3<R> V;             // covariance in camera axes
  R iz, kx, ky;                // 1/Z, clamped slopes
  bool x_free, y_free;         // slopes not clamped
  R a, b, c, e, g;             // Jacobian, rows (a, 0, b) and (0, c, e); g = db / ds
  R qz, yz, xy0, xy1, yy, iy;  // xy(s) = xy0 + s xy1, yy and 1 / yy; qz and yz are terms of xx and xy

  LFGS_HD Projection(const Camera<R>& camera, const Shape<R>& shape)
      : Body<R>(camera, shape, [](const glm::vec<3, R>& mean) { return mean.z; }) {
    if (!drawn) return;
    V = times_own_transpose(factor);

    // Jacobian, its slopes clamped at the rig's centre
    iz = 1 / t.z;
    R x = (t.x + camera.offset) * iz, y = t.y * iz;
    kx = x < camera.x_low ? camera.x_low : x > camera.x_high ? camera.x_high : x;
    ky = y < camera.y_low ? camera.y_low : y > camera.y_high ? camera.y_high : y;
    x_free = kx == x, y_free = ky == y;
    a = camera.fx * iz, b = -camera.fx * (kx - camera.offset * iz) * iz;
    c = camera.fy * iz, e = -camera.fy * ky * iz;
    g = camera.sweep * camera.fx * iz * iz;

    // Projected covariance, conditional on the row
    qz = a * V.xz + b * V.zz;
    yz = c * V.yz + e * V.zz;
    xy0 = a * (c * V.xy + e * V.xz) + b * yz;
    xy1 = g * yz;
    yy = c * c * V.yy + 2 * c * e * V.yz + e * e * V.zz + R(kBlurVariancePx);
    iy = 1 / yy;
  }

  // The splat; its reach_y is negative if it is not drawn.
  LFGS_HD Splat<R> splat(const Camera<R>& camera, R opacity) const {
    Splat<R> s{};
    s.reach_y = -1;
    s.depth = t.z;
    if (!drawn) return s;
    s.u0 = camera.fx * t.x * iz + camera.cx;
    s.du = camera.sweep * camera.fx * (camera.inverse_zero_depth - iz);
    s.v0 = camera.fy * t.y * iz + camera.cy;
    s.log2_opacity = std::log2(opacity);
    conditional_variance(s);
    s.tau = R(kHalfLog2e) * iy;
    s.c0 = xy0 * iy;
    s.c1 = xy1 * iy;
    s.reach_y = std::sqrt((s.log2_opacity - R(kLog2MinAlpha)) / s.tau);
    return s;
  }

  // The projected factor has the rows `across` + s g `deep` and `down` / iy^(1/2). Times its own transpose it is the
  // projected covariance without blur. m0 + s m1 are its minors, times iy^(1/2).
  struct Minors {
    glm::vec<3, R> across, deep, m0, m1;

    LFGS_HD explicit Minors(const Projection& p) {
      const glm::mat<3, 3, R> rows = glm::transpose(p.factor);
      const glm::vec<3, R> down = std::sqrt(p.iy) * (p.c * rows[1] + p.e * rows[2]);
      across = p.a * rows[0] + p.b * rows[2], deep = rows[2];
      m0 = glm::cross(across, down), m1 = p.g * glm::cross(deep, down);
    }
  };

  // Compute S(s) = xx(s) - xy(s)^2 / yy as a sum of squares of minors (Cauchy and Binet). The difference has no digits
  // left for a needle some thousand pixels long. So S(s) never falls below the blur's variance.
  LFGS_HD void conditional_variance(Splat<R>& s) const {
    const R blur(kBlurVariancePx);
    const Minors m(*this);
    s.S0 = (glm::dot(m.m0, m.m0) + blur * (1 + glm::dot(m.across, m.across) * iy)) / R(kHalfLog2e);
    s.S1 = 2 * (glm::dot(m.m0, m.m1) + blur * g * glm::dot(m.across, m.deep) * iy) / R(kHalfLog2e);
    s.S2 = (glm::dot(m.m1, m.m1) + blur * g * g * V.zz * iy) / R(kHalfLog2e);
  }

  // Return the part of an aperture in xx(s), px^2. Per unit of offset the mean moves by fx (1/Z0 - 1/Z) along its row.
  // Points deeper or nearer than the mean move by fx/Z^2 per unit of depth more or less. This is the exact second
  // moment of the averaged footprints; xy and yy stay the same (Zwicker et al., "Antialiasing for automultiscopic 3D
  // displays", 2006).
  LFGS_HD R aperture_variance(const Camera<R>& camera) const {
    const R per_offset = camera.fx * camera.aperture, shift = camera.inverse_zero_depth - iz, shear = iz * iz;
    return per_offset * per_offset * (shift * shift + shear * shear * V.zz);
  }

  // D(s) before compensate() divides it: S(s), in an anti-aliased scene without the blur.
  LFGS_HD Compensation<R> unfiltered_variance(const Camera<R>& camera, const Splat<R>& s) const {
    if (!camera.antialiased) return {s.S0, s.S1, s.S2};
    const Minors m(*this);
    return {glm::dot(m.m0, m.m0) / R(kHalfLog2e), 2 * glm::dot(m.m0, m.m1) / R(kHalfLog2e),
            glm::dot(m.m1, m.m1) / R(kHalfLog2e)};
  }

  // Compensate for the aperture and for the blur of anti-aliased scenes. Add the aperture to S(s), and lower the
  // opacity to its highest over the rig. So the splat's bounds hold for all cameras. Return the square of the factor.
  // `out` is D(s) divided by it; D(s) / S(s) is then at most 1.
  LFGS_HD R compensate(const Camera<R>& camera, Splat<R>& s, Compensation<R>& out) const {
    out = unfiltered_variance(camera, s);
    if (camera.aperture > 0) s.S0 += aperture_variance(camera) / R(kHalfLog2e);
    const R most = largest_ratio(s.S0, s.S1, s.S2, out);
    if (most > 0) out = {out.D0 / most, out.D1 / most, out.D2 / most};
    s.log2_opacity += std::log2(most) / 2;
    const R left = s.log2_opacity - R(kLog2MinAlpha);
    s.reach_y = left >= 0 ? std::sqrt(left / s.tau) : R(-1);  // also if seen edge-on, where it has no light
    return most;
  }

  // The backward pass of compensate() for one camera. Return the gradient of D, from the gradient of the lowered
  // opacity, and add the gradient of S to g.S0.
  LFGS_HD Compensation<R> compensate_backward(const Camera<R>& camera, Splat<R>& g) const {
    Splat<R> s;
    conditional_variance(s);
    const R D = unfiltered_variance(camera, s).D0, half = g.log2_opacity / R(2 * kLn2);
    if (camera.aperture > 0) s.S0 += aperture_variance(camera) / R(kHalfLog2e);
    g.S0 -= half / s.S0;
    return {half / D, 0, 0};
  }

  // Add to `out`, `camera_out` and, unless it is null, `optics_out` the gradients that follow from `s`, the gradient of
  // the splat. For a compensated splat add also those from `g_D`, the gradient of D before compensate() divides it.
  template <bool kCompensated = false>
  LFGS_HD void backward(const Camera<R>& camera, const Shape<R>& shape, const Splat<R>& s, Shape<R>& out,
                        CameraGradient<R>& camera_out, const Compensation<R>& g_D = {},
                        OpticsGradient<R>* optics_out = nullptr) const {
    if (!drawn) return;
    out.opacity += s.log2_opacity / (shape.opacity * R(kLn2));

    // From the conditional form to xx, xy and yy
    R gS0 = s.S0 / R(kHalfLog2e), gS1 = s.S1 / R(kHalfLog2e), gS2 = s.S2 / R(kHalfLog2e);
    R gQ0 = gS0, gQ1 = gS1, gQ2 = gS2, g_iy = 0;  // of -xy(s)^2 / yy; gS becomes the gradient of xx(s)
    [[maybe_unused]] const R g_aperture = gS0;    // of aperture_variance()
    if constexpr (kCompensated) {
      // D(s) = (xx(s) - blur) (1 - blur / yy) - xy(s)^2 / yy, where the blur counts
      const R gD0 = g_D.D0 / R(kHalfLog2e), gD1 = g_D.D1 / R(kHalfLog2e), gD2 = g_D.D2 / R(kHalfLog2e);
      const R blur(camera.antialiased ? kBlurVariancePx : 0), keep = 1 - blur * iy;
      const R xx = a * (a * V.xx + b * V.xz) + b * qz;
      gQ0 += gD0, gQ1 += gD1, gQ2 += gD2;
      gS0 += keep * gD0, gS1 += keep * gD1, gS2 += keep * gD2;
      g_iy = -blur * (gD0 * xx + gD1 * 2 * g * qz + gD2 * g * g * V.zz);
    }
    g_iy += -gQ0 * xy0 * xy0 - 2 * gQ1 * xy0 * xy1 - gQ2 * xy1 * xy1 + s.tau * R(kHalfLog2e) + s.c0 * xy0 + s.c1 * xy1;
    R g_xy0 = iy * (s.c0 - 2 * gQ0 * xy0 - 2 * gQ1 * xy1);
    R g_xy1 = iy * (s.c1 - 2 * gQ1 * xy0 - 2 * gQ2 * xy1);
    R g_yy = -g_iy * iy * iy;
    R g_qz = 2 * g * gS1;
    R g_yz = b * g_xy0 + g * g_xy1;

    // To the entries of the Jacobian
    R g_a = gS0 * 2 * (a * V.xx + b * V.xz) + g_qz * V.xz + g_xy0 * (c * V.xy + e * V.xz);
    R g_b = gS0 * 2 * (a * V.xz + b * V.zz) + g_qz * V.zz + g_xy0 * yz;
    R g_c = g_xy0 * a * V.xy + g_yz * V.yz + g_yy * 2 * (c * V.yy + e * V.yz);
    R g_e = g_xy0 * a * V.xz + g_yz * V.zz + g_yy * 2 * (c * V.yz + e * V.zz);
    R g_g = gS1 * 2 * qz + gS2 * 2 * g * V.zz + g_xy1 * yz;

    // To the covariance in camera axes
    Symmetric3<R> gV;
    gV.xx = gS0 * a * a;
    gV.xz = gS0 * 2 * a * b + g_qz * a + g_xy0 * a * e;
    gV.zz = gS0 * b * b + gS2 * g * g + g_qz * b + g_yz * e + g_yy * e * e;
    gV.xy = g_xy0 * a * c;
    gV.yz = g_yz * c + g_yy * 2 * c * e;
    gV.yy = g_yy * c * c;
    [[maybe_unused]] R g_iz_of_aperture = 0;
    if constexpr (kCompensated) {
      const R square = camera.fx * camera.aperture * camera.fx * camera.aperture * g_aperture, shear = iz * iz;
      gV.zz += square * shear * shear;
      g_iz_of_aperture = square * (4 * iz * shear * V.zz - 2 * (camera.inverse_zero_depth - iz));
    }

    // To the mean in camera axes; b = -fx (kx - offset iz) iz
    R g_kx = -camera.fx * iz * g_b, g_ky = -camera.fy * iz * g_e;
    R g_iz = camera.fx * g_a + camera.fy * g_c - camera.fx * (kx - 2 * camera.offset * iz) * g_b -
             camera.fy * ky * g_e + camera.sweep * camera.fx * (2 * iz * g_g - s.du) + camera.fx * t.x * s.u0 +
             camera.fy * t.y * s.v0;
    if constexpr (kCompensated) g_iz += g_iz_of_aperture;
    if (optics_out) {
      OpticsGradient<R>& o = *optics_out;
      const R shift = camera.inverse_zero_depth - iz, of_fan = s.du * shift + g_g * iz * iz;
      o[kFx] += s.u0 * t.x * iz + g_a * iz - g_b * (kx - camera.offset * iz) * iz + camera.sweep * of_fan;
      o[kFy] += s.v0 * t.y * iz + g_c * iz - g_e * ky * iz;
      o[kCx] += s.u0, o[kCy] += s.v0;
      o[kXLow] += !x_free && kx == camera.x_low ? g_kx : R(0);
      o[kXHigh] += !x_free && kx != camera.x_low ? g_kx : R(0);
      o[kYLow] += !y_free && ky == camera.y_low ? g_ky : R(0);
      o[kYHigh] += !y_free && ky != camera.y_low ? g_ky : R(0);
      o[kOffset] += (x_free ? g_kx * iz : R(0)) + camera.fx * iz * iz * g_b;
      o[kSweep] += camera.fx * of_fan;
      o[kInverseZeroDepth] += camera.sweep * camera.fx * s.du;
      if constexpr (kCompensated) {
        const R twice = 2 * camera.fx * camera.aperture * g_aperture;  // of fx times aperture, by its length
        const R spread = shift * shift + iz * iz * iz * iz * V.zz;
        o[kFx] += twice * camera.aperture * spread;
        o[kAperture] += twice * camera.fx * spread;
        o[kInverseZeroDepth] += twice * camera.fx * camera.aperture * shift;
      }
    }
    glm::vec<3, R> g_t(camera.fx * iz * s.u0, camera.fy * iz * s.v0, s.depth);
    if (x_free) g_t.x += g_kx * iz, g_iz += g_kx * (t.x + camera.offset);
    if (y_free) g_t.y += g_ky * iz, g_iz += g_ky * t.y;
    g_t.z -= g_iz * iz * iz;
    Body<R>::backward(camera, shape, times_own_transpose_backward(factor, gV), g_t, out, camera_out);
  }
};

}  // namespace lfgs
