// EWA projection of one Gaussian by a camera that is no pinhole (math/camera_model.h) or has a rolling shutter
// (math/rolling_shutter.h), and by any camera. The model is linear about the mean (Zwicker et al. 2001), so that the
// splat is as in math/projection.h, without a rig's terms.
#pragma once

#include <type_traits>

#include "math/camera_model.h"
#include "math/projection.h"
#include "math/rolling_shutter.h"

namespace lfgs {

// What the limits of a pinhole's slopes add to the gradient of a slope by z, with its own gradient by the slope's axis
// and by z (see Projection, whose Jacobian has the same limits).
template <class R>
struct SlopeExcess {
  R value = 0, by_axis = 0, by_z = 0;

  LFGS_HD static SlopeExcess of(R axis, R z, R low, R high) {
    const R iz = 1 / z, slope = axis * iz, kept = slope < low ? low : slope > high ? high : slope;
    if (kept == slope) return {};
    return {(slope - kept) * iz, iz * iz, (kept - 2 * slope) * iz * iz};
  }
};

// kRolling: by a rolling shutter of any model, else by a camera that is no pinhole.
template <class R, bool kRolling>
struct CurvedProjection : std::conditional_t<kRolling, Reading<R>, StillReading<R>>, Body<R> {
  using Read = std::conditional_t<kRolling, Reading<R>, StillReading<R>>;
  using Body<R>::t, Body<R>::factor, Body<R>::drawn;
  using Read::camera, Read::with_time;
  SeenAt<R> place;
  SlopeExcess<R> excess_x, excess_y;
  glm::vec<3, R> u_row, v_row;  // of the Jacobian at a fixed time
  glm::vec<3, R> across, down;  // rows of the Jacobian times the factor of the covariance
  R xx, xy, yy;                 // projected covariance with the blur

  LFGS_HD CurvedProjection(const Camera<R>& moving, const Shape<R>& shape)
      : Read(moving, shape.mean),
        Body<R>(camera, shape, [&](const glm::vec<3, R>& mean) { return depth_before(camera, mean); }) {
    drawn = drawn && Read::found && sees(camera, t);
    if (!drawn) return;
    place = seen_at(camera, t);
    u_row = place.u.gradient, v_row = place.v.gradient;
    if (kRolling && camera.model == CameraModel::kPinhole) {
      excess_x = SlopeExcess<R>::of(t.x + camera.offset, t.z, camera.x_low, camera.x_high);
      excess_y = SlopeExcess<R>::of(t.y, t.z, camera.y_low, camera.y_high);
      u_row.z += camera.fx * excess_x.value, v_row.z += camera.fy * excess_y.value;
    }
    across = with_time(u_row) * factor, down = with_time(v_row) * factor;
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
  LFGS_HD Splat<R> splat(R opacity) const {
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

  // Add to `out`, `camera_out`, `motion_out` and, unless it is null, `optics_out` the gradients that follow from `s`,
  // the gradient of the splat. Of a rolling shutter `g_eye` is the gradient of where the camera stands when it reads
  // the mean; else it is not read.
  LFGS_HD void backward(const Camera<R>& moving, const Shape<R>& shape, const Splat<R>& s, const glm::vec<3, R>& g_eye,
                        Shape<R>& out, CameraGradient<R>& camera_out, MotionGradient<R>& motion_out,
                        OpticsGradient<R>* optics_out = nullptr) const {
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
    const glm::vec<3, R> u_in_time = with_time(u_row), v_in_time = with_time(v_row);
    const glm::mat<3, 3, R> g_factor = glm::outerProduct(u_in_time, g_across) + glm::outerProduct(v_in_time, g_down);
    glm::vec<3, R> g_u = factor * g_across, g_v = factor * g_down;
    [[maybe_unused]] R u_by_time = 0, v_by_time = 0;
    if constexpr (kRolling) {
      u_by_time = glm::dot(g_u, Read::by_mean), v_by_time = glm::dot(g_v, Read::by_mean);
      g_u += u_by_time * Read::speed, g_v += v_by_time * Read::speed;  // now of the rows at a fixed time
    }

    // To the optics: u - cx, v - cy and their derivatives are proportional to fx and fy
    if (optics_out) {
      OpticsGradient<R>& o = *optics_out;
      o[kFx] += (s.u0 * (place.u.value - camera.cx) + glm::dot(g_u, u_row)) / camera.fx;
      o[kFy] += (s.v0 * (place.v.value - camera.cy) + glm::dot(g_v, v_row)) / camera.fy;
      o[kCx] += s.u0, o[kCy] += s.v0;
    }

    // To the mean in camera axes, at a fixed time
    glm::vec<3, R> g_t =
        s.u0 * place.u.gradient + s.v0 * place.v.gradient + place.u.second * g_u + place.v.second * g_v;
    const R depth = depth_before(camera, t);
    g_t += depth == t.z ? glm::vec<3, R>(0, 0, s.depth) : t * (s.depth / depth);
    if constexpr (kRolling) {
      const R g_excess_x = camera.fx * g_u.z, g_excess_y = camera.fy * g_v.z;
      g_t += glm::vec<3, R>(g_excess_x * excess_x.by_axis, g_excess_y * excess_y.by_axis,
                            g_excess_x * excess_x.by_z + g_excess_y * excess_y.by_z);
      if (optics_out) {
        OpticsGradient<R>& o = *optics_out;
        o[kOffset] += g_excess_x * excess_x.by_axis;
        o[kXLow] -= excess_x.value < 0 ? g_excess_x / t.z : R(0);
        o[kXHigh] -= excess_x.value > 0 ? g_excess_x / t.z : R(0);
        o[kYLow] -= excess_y.value < 0 ? g_excess_y / t.z : R(0);
        o[kYHigh] -= excess_y.value > 0 ? g_excess_y / t.z : R(0);
      }

      // The speed is turn x t - way, and rows in time also depend on the gradient of the coordinate that is read
      const glm::vec<3, R>& speed = Read::speed;
      const glm::vec<3, R> g_speed = u_by_time * u_in_time + v_by_time * v_in_time;
      const glm::vec<3, R> g_read = Read::per_px * (glm::dot(u_row, speed) * g_u + glm::dot(v_row, speed) * g_v);
      g_t += Read::along(place).second * g_read + glm::cross(g_speed, moving.turn);

      // Through time
      R g_time = glm::dot(g_t, speed) - glm::dot(g_speed, glm::cross(moving.turn, Read::way)) +
                 glm::dot(g_eye, glm::transpose(camera.rotation) * Read::way);
      for (int k = 0; k < 3; ++k) g_time += glm::dot(g_factor[k], glm::cross(moving.turn, factor[k]));
      g_t += g_time * Read::by_mean;
      if (optics_out) {
        const bool columns = camera.shutter == Shutter::kColumns;
        const R g_value = g_time * Read::per_px;  // of the coordinate that is read
        const R focal = columns ? camera.fx : camera.fy, centre = columns ? camera.cx : camera.cy;
        const Jet<R>& read = Read::along(place);
        const R g_focal = (g_value * (read.value - centre) + glm::dot(g_read, read.gradient)) / focal;
        OpticsGradient<R>& o = *optics_out;
        o[kFx] += columns ? g_focal : R(0), o[kCx] += columns ? g_value : R(0);
        o[kFy] += columns ? R(0) : g_focal, o[kCy] += columns ? R(0) : g_value;
      }

      // To the Gaussian, to the camera at its time, whose centre is -R^T t, and to the motion
      CameraGradient<R> at;
      Body<R>::backward(camera, shape, g_factor, g_t, out, at);
      at.rotation -= glm::outerProduct(camera.translation, g_eye);
      at.translation -= camera.rotation * g_eye;
      Read::backward(moving, at, -g_speed, glm::cross(t, g_speed), camera_out, motion_out);
    } else {
      Body<R>::backward(camera, shape, g_factor, g_t, out, camera_out);
    }
  }
};

// Project a Gaussian by a camera of any model; sets `compensation` if its opacity is compensated for a rig.
// kMayRoll: whether its shutter may be a rolling one.
template <bool kMayRoll = true, class R>
LFGS_HD Splat<R> projected(const Camera<R>& camera, const Shape<R>& shape, Compensation<R>& compensation) {
  if constexpr (kMayRoll)
    if (camera.shutter != Shutter::kGlobal) return CurvedProjection<R, true>(camera, shape).splat(shape.opacity);
  if (camera.model != CameraModel::kPinhole) return CurvedProjection<R, false>(camera, shape).splat(shape.opacity);
  const Projection<R> projection(camera, shape);
  Splat<R> splat = projection.splat(camera, shape.opacity);
  if (camera.compensated() && splat.reach_y >= 0) projection.compensate(camera, splat, compensation);
  return splat;
}

// Add to `out`, `camera_out`, `motion_out` and, unless it is null, `optics_out` the gradients that follow from
// `g_splat`, the gradient of the splat of one camera of any model; see CurvedProjection for `g_eye`.
template <class R>
LFGS_HD void projected_backward(const Camera<R>& camera, const Shape<R>& shape, Splat<R> g_splat,
                                const glm::vec<3, R>& g_eye, Shape<R>& out, CameraGradient<R>& camera_out,
                                MotionGradient<R>& motion_out, OpticsGradient<R>* optics_out) {
  auto curved = [&](const auto& projection) {
    projection.backward(camera, shape, g_splat, g_eye, out, camera_out, motion_out, optics_out);
  };
  if (camera.shutter != Shutter::kGlobal) return curved(CurvedProjection<R, true>(camera, shape));
  if (camera.model != CameraModel::kPinhole) return curved(CurvedProjection<R, false>(camera, shape));
  const Projection<R> projection(camera, shape);
  if (!projection.drawn) return;
  if (camera.compensated()) {
    const Compensation<R> g_compensation = projection.compensate_backward(camera, g_splat);
    projection.template backward<true>(camera, shape, g_splat, out, camera_out, g_compensation, optics_out);
  } else {
    projection.backward(camera, shape, g_splat, out, camera_out, {}, optics_out);
  }
}

}  // namespace lfgs
