// The models of cameras: where a point in camera axes is seen, with first and second derivatives.
// The derivatives are by a Jet, a number that carries its own (forward differentiation to second order).
//   pinhole           u = fx X / Z + cx,  v = fy Y / Z + cy
//   orthographic      u = fx X + cx,  v = fy Y + cy
//   fisheye           u = fx d X / r + cx,  v = fy d Y / r + cy,  r^2 = X^2 + Y^2,  theta = atan2(r, Z),
//                     d = theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8)   (Kannala & Brandt 2006,
//                     OpenCV)
//   equirectangular   u = fx atan2(X, Z) + cx,  v = fy atan2(Y, (X^2 + Z^2)^(1/2)) + cy
#pragma once

#include <glm/glm.hpp>

#include <cmath>

#include "math/constants.h"
#include "math/covariance.h"
#include "scene/camera.h"

namespace lfgs {

// A number with its gradient and its second derivatives by a point.
template <class R>
struct Jet {
  R value = 0;
  glm::vec<3, R> gradient{R(0)};
  Symmetric3<R> second{};
};

// a b^T + b a^T
template <class R>
LFGS_HD Symmetric3<R> symmetric_product(const glm::vec<3, R>& a, const glm::vec<3, R>& b) {
  return {2 * a.x * b.x, a.x * b.y + a.y * b.x, a.x * b.z + a.z * b.x,
          2 * a.y * b.y, a.y * b.z + a.z * b.y, 2 * a.z * b.z};
}

template <class R>
LFGS_HD void add_scaled(Symmetric3<R>& sum, R factor, const Symmetric3<R>& m) {
  sum.xx += factor * m.xx, sum.xy += factor * m.xy, sum.xz += factor * m.xz;
  sum.yy += factor * m.yy, sum.yz += factor * m.yz, sum.zz += factor * m.zz;
}

template <class R>
LFGS_HD Jet<R> operator+(const Jet<R>& a, const Jet<R>& b) {
  Jet<R> out{a.value + b.value, a.gradient + b.gradient, a.second};
  add_scaled(out.second, R(1), b.second);
  return out;
}

template <class R>
LFGS_HD Jet<R> operator*(const Jet<R>& a, const Jet<R>& b) {
  Jet<R> out{a.value * b.value, a.value * b.gradient + b.value * a.gradient, symmetric_product(a.gradient, b.gradient)};
  add_scaled(out.second, b.value, a.second);
  add_scaled(out.second, a.value, b.second);
  return out;
}

template <class R>
LFGS_HD Jet<R> scaled_and_moved(const Jet<R>& a, R factor, R offset) {
  Jet<R> out{factor * a.value + offset, factor * a.gradient, {}};
  add_scaled(out.second, factor, a.second);
  return out;
}

// f(a), from f and its derivatives at a.
template <class R>
LFGS_HD Jet<R> chained(const Jet<R>& a, R f, R f1, R f2) {
  Jet<R> out{f, f1 * a.gradient, {}};
  add_scaled(out.second, f1, a.second);
  add_scaled(out.second, f2 / 2, symmetric_product(a.gradient, a.gradient));
  return out;
}

template <class R>
LFGS_HD Jet<R> jet_root(const Jet<R>& a) {
  const R root = std::sqrt(a.value), inverse = 1 / root;
  return chained(a, root, inverse / 2, -inverse / (4 * a.value));
}

template <class R>
LFGS_HD Jet<R> jet_inverse(const Jet<R>& a) {
  const R inverse = 1 / a.value;
  return chained(a, inverse, -inverse * inverse, 2 * inverse * inverse * inverse);
}

template <class R>
LFGS_HD Jet<R> jet_atan2(const Jet<R>& y, const Jet<R>& x) {
  const R square = x.value * x.value + y.value * y.value, by_y = x.value / square, by_x = -y.value / square;
  Jet<R> out{std::atan2(y.value, x.value), by_y * y.gradient + by_x * x.gradient, {}};
  add_scaled(out.second, by_y, y.second);
  add_scaled(out.second, by_x, x.second);
  add_scaled(out.second, by_y * by_x, symmetric_product(y.gradient, y.gradient));
  add_scaled(out.second, -by_y * by_x, symmetric_product(x.gradient, x.gradient));
  add_scaled(out.second, by_x * by_x - by_y * by_y, symmetric_product(x.gradient, y.gradient));
  return out;
}

template <class R>
LFGS_HD glm::vec<3, R> operator*(const Symmetric3<R>& m, const glm::vec<3, R>& v) {
  return {m.xx * v.x + m.xy * v.y + m.xz * v.z, m.xy * v.x + m.yy * v.y + m.yz * v.z,
          m.xz * v.x + m.yz * v.y + m.zz * v.z};
}

// A place in the image, pixels.
template <class R>
struct SeenAt {
  Jet<R> u, v;
};

template <class R>
LFGS_HD SeenAt<R> seen_by_fisheye(const Camera<R>& camera, const Jet<R>& x, const Jet<R>& y, const Jet<R>& z) {
  const Jet<R> square = x * x + y * y;
  // theta / r, near the axis by its series in q = (r / Z)^2, for there r has no derivative
  Jet<R> ratio;
  if (square.value < R(1e-6) * z.value * z.value && z.value > 0) {
    const Jet<R> inverse = jet_inverse(z), q = square * inverse * inverse;
    ratio = inverse * scaled_and_moved(q * scaled_and_moved(q, R(0.2), R(-1) / 3), R(1), R(1));
  } else {
    const Jet<R> radius = jet_root(square);
    ratio = jet_atan2(radius, z) * jet_inverse(radius);
  }
  const Jet<R> angle_square = square * ratio * ratio;
  Jet<R> bent = scaled_and_moved(angle_square, camera.bend[3], camera.bend[2]);
  bent = scaled_and_moved(angle_square * bent, R(1), camera.bend[1]);
  bent = scaled_and_moved(angle_square * bent, R(1), camera.bend[0]);
  bent = ratio * scaled_and_moved(angle_square * bent, R(1), R(1));
  return {scaled_and_moved(x * bent, camera.fx, camera.cx), scaled_and_moved(y * bent, camera.fy, camera.cy)};
}

// Where a camera sees a point in its axes.
template <class R>
LFGS_HD SeenAt<R> seen_at(const Camera<R>& camera, const glm::vec<3, R>& t) {
  const Jet<R> x{t.x, {1, 0, 0}, {}}, y{t.y, {0, 1, 0}, {}}, z{t.z, {0, 0, 1}, {}};
  if (camera.model == CameraModel::kFisheye) return seen_by_fisheye(camera, x, y, z);
  if (camera.model == CameraModel::kEquirectangular)
    return {scaled_and_moved(jet_atan2(x, z), camera.fx, camera.cx),
            scaled_and_moved(jet_atan2(y, jet_root(x * x + z * z)), camera.fy, camera.cy)};
  if (camera.model == CameraModel::kPinhole) {
    const Jet<R> inverse = jet_inverse(z);
    return {scaled_and_moved(x * inverse, camera.fx, camera.cx), scaled_and_moved(y * inverse, camera.fy, camera.cy)};
  }
  return {scaled_and_moved(x, camera.fx, camera.cx), scaled_and_moved(y, camera.fy, camera.cy)};
}

// Whether the model is defined about a point. A fisheye has a widest angle; next to the poles of an equirectangular
// picture, within .06 degrees, its Jacobian grows without bounds.
template <class R>
LFGS_HD bool sees(const Camera<R>& camera, const glm::vec<3, R>& t) {
  if (camera.model == CameraModel::kFisheye) return std::atan2(std::sqrt(t.x * t.x + t.y * t.y), t.z) < camera.widest;
  if (camera.model == CameraModel::kEquirectangular) return t.x * t.x + t.z * t.z > R(1e-6) * t.y * t.y;
  return true;
}

// What orders Gaussians before a camera: z where all that it sees lies ahead, else the distance.
template <class R>
LFGS_HD R depth_before(const Camera<R>& camera, const glm::vec<3, R>& t) {
  const bool ahead = camera.model == CameraModel::kPinhole || camera.model == CameraModel::kOrthographic ||
                     (camera.model == CameraModel::kFisheye && camera.widest <= R(kPi / 2));
  return ahead ? t.z : glm::length(t);
}

}  // namespace lfgs
