// The gradient of a rig: of its pose and its optics. Colours are seen from its cameras, whose places follow from the
// pose and the sweep.
#pragma once

#include <glm/glm.hpp>

#include "base/config.h"
#include "math/colour_circle.h"
#include "math/projection.h"
#include "scene/camera.h"

namespace lfgs {

constexpr int kPoseNumbers = 16, kRigNumbers = kPoseNumbers + kRigOptics;

struct RigGradient {
  CameraGradient<double> pose;
  OpticsGradient<double> optics;
  glm::dvec3 centre{0}, right{0};  // of Camera::centre() and Camera::right(), until to_pose()

  // Add the gradient of where the camera at s stands.
  LFGS_HD void add_eye(const Camera<double>& rig, double s, const glm::dvec3& g_eye) {
    centre += g_eye, right += s * rig.sweep * g_eye;
    optics[kSweep] += s * glm::dot(g_eye, rig.right());
  }
  // Add the gradient of the circle on which the rig sees a mean; g_mean is the gradient of that mean.
  LFGS_HD void add_circle(const Camera<double>& rig, const ColourCircle<double>& circle,
                          const CircleGradient<double>& g_circle, const glm::dvec3& g_mean) {
    const LineGradient<double> g_line(rig, circle, g_circle);
    centre -= g_mean, right += g_line.right, optics[kSweep] += g_line.sweep;
  }
  // Move the gradients of the centre, -R^T t, and of the x-axis, the first row of R, to the pose.
  LFGS_HD void to_pose(const Camera<double>& rig) {
    pose.rotation += glm::outerProduct(-rig.translation, centre);
    pose.translation -= rig.rotation * centre;
    for (int column = 0; column < 3; ++column) pose.rotation[column][0] += right[column];
    centre = right = glm::dvec3(0);
  }
  // Number k of kRigNumbers: world_to_camera by rows, then the optics.
  LFGS_HD double number(int k) const {
    if (k >= kPoseNumbers) return optics.numbers[k - kPoseNumbers];
    const int row = k / 4, column = k % 4;
    return row == 3 ? 0 : column == 3 ? pose.translation[row] : pose.rotation[column][row];
  }
  LFGS_HD RigGradient& operator+=(const RigGradient& other) {
    pose.rotation += other.pose.rotation, pose.translation += other.pose.translation;
    optics += other.optics, centre += other.centre, right += other.right;
    return *this;
  }
};

}  // namespace lfgs
