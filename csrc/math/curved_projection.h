// EWA projection of one Gaussian by a camera that is no pinhole (math/camera_model.h), and by any camera. The model is
// linear about the mean (Zwicker et al. 2001), so that the splat is as in math/projection.h, without a rig's terms.
#pragma once

#include "math/camera_model.h"
#include "math/projection.h"

namespace lfgs {

template <class R>
struct CurvedProjection : Body<R> {
  using Body<R>::t, Body<R>::factor, Body<R>::drawn;
  SeenAt<R> place;
  glm::vec<3, R> across, down;  // rows of the Jacobian times the factor of the covariance
  R xx, xy, yy;                 // projected covariance with the blur

  LFGS_HD CurvedProjection(const Camera<R>& camera, const Shape<R>& shape)
      : Body<R>(camera, shape, [&](const glm::vec<3, R>& mean) { return depth_before(camera, mean); }) {
    drawn = drawn && sees(camera, t);
    if (!drawn) return;
    place = seen_at(camera, t);
    across = place.u.gradient * factor, down = place.v.gradient * factor;
    xx = glm::dot(across, across) + R(kBlurVariancePx);
    xy = glm::dot(across, down);
    yy = glm::dot(down, down) + R(kBlurVariancePx);
  }

  // Determinant of the covariance without the blur, and with it, as sums of squares (see Projection::Minors).
  LFGS_HD R sharp_determinant() const {
    const glm::vec<3, R> minors = glm::cross(across, down);
    return glm::dot(minors, minors);
  }
  LFGS_HD R determinant() const {
    const R blur(kBlurVariancePx);
    return sharp_determinant() + blur * (glm::dot(across, across) + glm::dot(down, down) + blur);
  }

  // The splat; its reach_y is negative if it is not drawn. Opacities of anti-aliased scenes are compensated.
  LFGS_HD Splat<R> splat(const Camera<R>& camera, R opacity) const {
    Splat<R> s{};
    s.reach_y = -1;
    s.depth = depth_before(camera, t);
    if (!drawn) return s;
    s.u0 = place.u.value, s.v0 = place.v.value;
    s.log2_opacity = std::log2(opacity);
    if (camera.antialiased) s.log2_opacity += std::log2(sharp_determinant() / determinant()) / 2;
    s.S0 = determinant() / (yy * R(kHalfLog2e));
    s.tau = R(kHalfLog2e) / yy;
    s.c0 = xy / yy;
    const R left = s.log2_opacity - R(kLog2MinAlpha);
    s.reach_y = left >= 0 ? std::sqrt(left / s.tau) : R(-1);
    return s;
  }

  // Add to `out` and `camera_out` the gradients that follow from `s`, the gradient of the splat.
  LFGS_HD void backward(const Camera<R>& camera, const Shape<R>& shape, const Splat<R>& s, Shape<R>& out,
                        CameraGradient<R>& camera_out) const {
    if (!drawn) return;
    out.opacity += s.log2_opacity / (shape.opacity * R(kLn2));

    // To the covariance: S = xx - xy^2 / yy, tau ~ 1 / yy, c0 = xy / yy
    const R iy = 1 / yy, slope = xy * iy, gS = s.S0 / R(kHalfLog2e);
    R g_xx = gS, g_xy = iy * (s.c0 - 2 * xy * gS);
    R g_yy = slope * slope * gS - iy * (R(kHalfLog2e) * iy * s.tau + slope * s.c0);
    if (camera.antialiased) {
      const R half = s.log2_opacity / R(2 * kLn2), sharp = half / sharp_determinant(), wide = half / determinant();
      const R blur(kBlurVariancePx);
      g_xx += sharp * (yy - blur) - wide * yy;
      g_yy += sharp * (xx - blur) - wide * xx;
      g_xy -= 2 * xy * (sharp - wide);
    }

    // To the rows of the Jacobian, and to the factor
    const glm::vec<3, R> g_across = 2 * g_xx * across + g_xy * down, g_down = 2 * g_yy * down + g_xy * across;
    const glm::vec<3, R> g_u = factor * g_across, g_v = factor * g_down;  // of the gradients of u and v
    const glm::mat<3, 3, R> g_factor =
        glm::outerProduct(place.u.gradient, g_across) + glm::outerProduct(place.v.gradient, g_down);

    // To the mean in camera axes
    glm::vec<3, R> g_t =
        s.u0 * place.u.gradient + s.v0 * place.v.gradient + times(place.u.second, g_u) + times(place.v.second, g_v);
    const R depth = depth_before(camera, t);
    g_t += depth == t.z ? glm::vec<3, R>(0, 0, s.depth) : t * (s.depth / depth);
    Body<R>::backward(camera, shape, g_factor, g_t, out, camera_out);
  }

 private:
  static LFGS_HD glm::vec<3, R> times(const Symmetric3<R>& m, const glm::vec<3, R>& v) {
    return {m.xx * v.x + m.xy * v.y + m.xz * v.z, m.xy * v.x + m.yy * v.y + m.yz * v.z,
            m.xz * v.x + m.yz * v.y + m.zz * v.z};
  }
};

// Project a Gaussian by a camera of any model; sets `compensation` if its opacity is compensated for a rig.
template <class R>
LFGS_HD Splat<R> projected(const Camera<R>& camera, const Shape<R>& shape, Compensation<R>& compensation) {
  if (camera.model != CameraModel::kPinhole) return CurvedProjection<R>(camera, shape).splat(camera, shape.opacity);
  const Projection<R> projection(camera, shape);
  Splat<R> splat = projection.splat(camera, shape.opacity);
  if (camera.compensated() && splat.reach_y >= 0) projection.compensate(camera, splat, compensation);
  return splat;
}

// Add to `out` and `camera_out` the gradients that follow from `g_splat`, the gradient of the splat of one camera of
// any model.
template <class R>
LFGS_HD void projected_backward(const Camera<R>& camera, const Shape<R>& shape, Splat<R> g_splat, Shape<R>& out,
                                CameraGradient<R>& camera_out) {
  if (camera.model != CameraModel::kPinhole) {
    CurvedProjection<R>(camera, shape).backward(camera, shape, g_splat, out, camera_out);
    return;
  }
  const Projection<R> projection(camera, shape);
  if (!projection.drawn) return;
  if (camera.compensated()) {
    const Compensation<R> g_compensation = projection.compensate_backward(camera, g_splat);
    projection.template backward<true>(camera, shape, g_splat, out, camera_out, g_compensation);
  } else {
    projection.backward(camera, shape, g_splat, out, camera_out);
  }
}

}  // namespace lfgs
