// A camera for projection, of any model, or a whole rig of pinhole cameras that are projected to at once.
#pragma once

#include <glm/glm.hpp>

#include "base/config.h"

namespace lfgs {

// How a camera maps points to pixels, see math/camera_model.h.
enum class CameraModel : int { kPinhole, kOrthographic, kFisheye, kEquirectangular };
constexpr int kCameraModels = 4;

// Which part of the image a rolling shutter reads at a time, from the top or the left (math/rolling_shutter.h).
enum class Shutter : int { kGlobal, kRows, kColumns };
constexpr int kShutters = 3;

// A camera (OpenCV axes, pixel centres at i + 0.5). A pinhole camera with a sweep is a rig. Its cameras stand on the
// camera x-axis at offset s. Their principal points are shifted such that the plane z = zero_depth shows no parallax.
template <class R>
struct Camera {
  glm::mat<3, 3, R> rotation{R(1)};  // world to camera
  glm::vec<3, R> translation{R(0)};
  CameraModel model = CameraModel::kPinhole;
  R fx = 1, fy = 1, cx = 0, cy = 0;  // pixels; of an orthographic camera fx and fy are pixels per unit, else per radian
  R x_low = -1, x_high = 1;          // limits of X/Z and Y/Z in the Jacobian, at the rig's centre (offset 0)
  R y_low = -1, y_high = 1;
  R offset = 0;              // where this camera stands in its rig; only the clamp needs it
  R sweep = 0;               // of a rig, the offset at s = 1; 0: one camera
  R inverse_zero_depth = 0;  // of a rig, or of cameras with an aperture
  R aperture = 0;            // standard deviation of the offsets that the picture is averaged over; 0: a pinhole
  R bend[4] = {0, 0, 0, 0};  // of a fisheye: k1..k4 of OpenCV
  R widest = 0;              // of a fisheye: points at larger angles from the axis are not drawn, radians
  bool antialiased = false;  // opacities compensated for the blur, see math/compensation.h
  Shutter shutter = Shutter::kGlobal;
  // Of a rolling shutter, from the first row (or column) to the last: the rotation, as a vector, and the camera's way,
  // both in the axes of the camera at the first row. The pose above is then that of the first row.
  glm::vec<3, R> turn{R(0)}, way{R(0)};
  R read_per_px = 0;  // times of a readout

  // Whether opacities are lowered, because the blur, the aperture or both widen footprints.
  LFGS_HD bool compensated() const { return antialiased || aperture > 0; }

  LFGS_HD glm::vec<3, R> centre() const { return -(glm::transpose(rotation) * translation); }
  // The camera x-axis, on which the cameras of a rig stand.
  LFGS_HD glm::vec<3, R> right() const { return {rotation[0][0], rotation[1][0], rotation[2][0]}; }
  // Where the camera at the normalized offset s of a rig stands.
  LFGS_HD glm::vec<3, R> eye_at(R s) const { return centre() + s * sweep * right(); }
};

// world_to_camera: 16 numbers, row-major; intrinsics: fx, fy, cx, cy; limits: x_low, x_high, y_low, y_high, offset. Of
// other models than the pinhole the limits are `bend` and `widest`.
template <class R, class T>
LFGS_HD Camera<R> make_camera(const T* world_to_camera, const T* intrinsics, const T* limits,
                              CameraModel model = CameraModel::kPinhole) {
  Camera<R> out;
  out.model = model;
  for (int row = 0; row < 3; ++row) {
    for (int col = 0; col < 3; ++col) out.rotation[col][row] = world_to_camera[4 * row + col];
    out.translation[row] = world_to_camera[4 * row + 3];
  }
  out.fx = intrinsics[0], out.fy = intrinsics[1], out.cx = intrinsics[2], out.cy = intrinsics[3];
  if (model != CameraModel::kPinhole) {
    for (int k = 0; k < 4; ++k) out.bend[k] = limits[k];
    out.widest = limits[4];
    return out;
  }
  out.x_low = limits[0], out.x_high = limits[1], out.y_low = limits[2], out.y_high = limits[3], out.offset = limits[4];
  return out;
}

}  // namespace lfgs
