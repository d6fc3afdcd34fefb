// A rolling shutter reads the rows of an image one after another, while the camera moves. So each Gaussian has a pose
// of its own: where the camera is when it reads the row of the Gaussian's mean (columns likewise).
//
// The camera turns about one axis at constant speed (slerp), and its centre moves along a line. At time 0 it reads the
// first row, at time 1 the last. Of a mean m, with E(s) the rotation by the vector s turn,
//   t(s) = E(s) (R m + T - s way),   dt/ds = turn x t - E way.
// The mean is read at the time s for which s = (row(t(s)) - 1/2) read_per_px. Newton's method finds it in kTimeSteps
// steps from the middle. A step turns an error e into q e^2 or less, where 2 q is the largest |row''| read_per_px over
// the smallest 1 - row' read_per_px. For q <= 1/2 the steps leave less than 1e-15. Beyond the image time goes on for
// kTimeMargin of the readout, and is held there. Means that move with the shutter nearly as fast as it reads, and those
// whose row the steps do not find, are not drawn.
//
// All derivatives are exact, by the implicit function: time has the gradient by_mean, so a projection with the
// Jacobian J has the Jacobian J + (J dt/ds) by_mean^T, which shears and stretches footprints as the shutter does.
#pragma once

#include "math/camera_model.h"
#include "math/projection.h"

namespace lfgs {

constexpr int kTimeSteps = 5;
constexpr double kTimeMargin = 0.15;     // as far as the limits of Jacobians reach, see Cameras.jacobian_limits
constexpr double kLeastSlack = 0.25;     // of 1 - row' read_per_px: footprints are at most four times as long
constexpr double kTimeTolerance = 1e-9;  // of a readout

// The gradients of Camera::turn and Camera::way.
template <class R>
struct MotionGradient {
  glm::vec<3, R> turn{R(0)}, way{R(0)};
};

// The rotation by a vector, E = 1 + a [v] + b [v]^2. The gradient of v needs c too: E changes by [L dv] E, with
// L = 1 + b [v] + c [v]^2.
template <class R>
struct Turn {
  glm::vec<3, R> v;
  R a, b, c;

  LFGS_HD explicit Turn(const glm::vec<3, R>& vector) : v(vector) {
    const R square = glm::dot(v, v);
    if (square < R(1e-2)) {
      a = 1 - square / 6 * (1 - square / 20 * (1 - square / 42 * (1 - square / 72)));
      b = (1 - square / 12 * (1 - square / 30 * (1 - square / 56 * (1 - square / 90)))) / 2;
      c = (1 - square / 20 * (1 - square / 42 * (1 - square / 72 * (1 - square / 110)))) / 6;
    } else {
      const R angle = std::sqrt(square);
      a = std::sin(angle) / angle, b = (1 - std::cos(angle)) / square, c = (1 - a) / square;
    }
  }

  LFGS_HD glm::vec<3, R> operator*(const glm::vec<3, R>& x) const { return applied(x, a, b); }
  LFGS_HD glm::vec<3, R> back(const glm::vec<3, R>& x) const { return applied(x, -a, b); }
  // The gradient of v from that of the infinitesimal rotation on the left of E.
  LFGS_HD glm::vec<3, R> gradient(const glm::vec<3, R>& g_left) const { return applied(g_left, -b, c); }

 private:
  LFGS_HD glm::vec<3, R> applied(const glm::vec<3, R>& x, R first, R second) const {
    const glm::vec<3, R> once = glm::cross(v, x);
    return x + first * once + second * glm::cross(v, once);
  }
};

// A camera with a global shutter, in the place of a Reading.
template <class R>
struct StillReading {
  const Camera<R>& camera;
  bool found = true;

  LFGS_HD StillReading(const Camera<R>& still, const glm::vec<3, R>&) : camera(still) {}
  LFGS_HD const glm::vec<3, R>& with_time(const glm::vec<3, R>& jacobian) const { return jacobian; }
};

// The camera when it reads a mean, and how the reading depends on time.
template <class R>
struct Reading {
  Camera<R> camera;              // where it stands at that time
  R time = 0, per_px = 0;        // 0 to 1; change of time per pixel by which the mean moves in the image
  glm::vec<3, R> way{R(0)};      // of the camera while it reads all rows, in its axes at that time
  glm::vec<3, R> speed{R(0)};    // of the mean in camera axes, dt/ds
  glm::vec<3, R> by_mean{R(0)};  // gradient of time by the mean in camera axes
  bool found = true;

  LFGS_HD Reading(const Camera<R>& moving, const glm::vec<3, R>& mean) : camera(moving) {
    const auto within = [](R s) { return glm::clamp(s, R(-kTimeMargin), R(1 + kTimeMargin)); };
    time = R(0.5);
    for (int step = 0;; ++step) {
      move_to(moving, time);
      const glm::vec<3, R> t = camera.rotation * mean + camera.translation;
      found = depth_before(camera, t) >= R(kNearDepth) && sees(camera, t);
      if (!found) return;
      const SeenAt<R> place = seen_at(camera, t);
      const Jet<R>& read = along(place);
      speed = glm::cross(moving.turn, t) - way;
      const R wanted = (read.value - R(0.5)) * moving.read_per_px;
      const R slack = 1 - moving.read_per_px * glm::dot(read.gradient, speed);
      if (step < kTimeSteps) {
        time = within(time + (wanted - time) / glm::max(slack, R(kLeastSlack)));
        continue;
      }
      if (wanted != within(wanted)) {
        found = time == within(wanted);
        return;
      }
      found = slack >= R(kLeastSlack) && glm::abs(wanted - time) <= R(kTimeTolerance);
      per_px = moving.read_per_px / slack, by_mean = per_px * read.gradient;
      return;
    }
  }

  // The coordinate along which the shutter reads.
  LFGS_HD const Jet<R>& along(const SeenAt<R>& place) const {
    return camera.shutter == Shutter::kColumns ? place.u : place.v;
  }

  // The gradient of a projection by the mean in camera axes, from its gradient at a fixed time.
  LFGS_HD glm::vec<3, R> with_time(const glm::vec<3, R>& jacobian) const {
    return jacobian + glm::dot(jacobian, speed) * by_mean;
  }

  // Add to `out` and `motion_out` the gradients that follow from `at`, of the camera at that time, and from that of
  // `way` for a fixed pose.
  LFGS_HD void backward(const Camera<R>& moving, const CameraGradient<R>& at, const glm::vec<3, R>& g_way,
                        const glm::vec<3, R>& g_turn, CameraGradient<R>& out, MotionGradient<R>& motion_out) const {
    const Turn<R> turned(time * moving.turn);
    const glm::vec<3, R> g_translation = turned.back(at.translation);
    glm::vec<3, R> g_left = glm::cross(camera.translation, at.translation) + glm::cross(way, g_way);
    for (int column = 0; column < 3; ++column) {
      out.rotation[column] += turned.back(at.rotation[column]);
      g_left += glm::cross(camera.rotation[column], at.rotation[column]);
    }
    out.translation += g_translation;
    motion_out.way += turned.back(g_way) - time * g_translation;
    motion_out.turn += g_turn + time * turned.gradient(g_left);
  }

 private:
  LFGS_HD void move_to(const Camera<R>& moving, R to) {
    const Turn<R> turned(to * moving.turn);
    for (int column = 0; column < 3; ++column) camera.rotation[column] = turned * moving.rotation[column];
    camera.translation = turned * (moving.translation - to * moving.way);
    way = turned * moving.way;
  }
};

// Where the camera stands when it reads a mean.
template <class R>
LFGS_HD glm::vec<3, R> eye_of(const Camera<R>& camera, const glm::vec<3, R>& mean) {
  return Reading<R>(camera, mean).camera.centre();
}

}  // namespace lfgs
