// How kernels project one Gaussian, with and without compensation (math/compensation.h). Backward passes project again
// rather than keep all splats.
#pragma once

#include "math/curved_projection.h"
#include "stages/stages.h"

namespace lfgs::cuda {

__device__ inline Shape<double> widened(const Shape<float>& s) { return {s.mean, s.quaternion, s.scale, s.opacity}; }

// Project a splat and find its compensation. It is in double, since the area of a splat that is long and thinner than
// a pixel has few digits left in float. (Without compensation that does not matter, since only the blur shows.)
__device__ inline Splat<float> compensated_splat(const Camera<double>& camera, const Shape<float>& shape,
                                                 Compensation<float>& out) {
  const Shape<double> wide = widened(shape);
  const Projection<double> projection(camera, wide);
  Splat<double> splat = projection.splat(camera, wide.opacity);
  Compensation<double> exact{};
  if (splat.reach_y >= 0) projection.compensate(camera, splat, exact);
  out = {float(exact.D0), float(exact.D1), float(exact.D2)};
  return splat_cast<float>(splat);
}

// D(s), not below zero.
__device__ inline float unfiltered(const Compensation<float>& c, float s) {
  return fmaxf(fmaf(fmaf(s, c.D2, c.D1), s, c.D0), 0.f);
}

// Log2 of a splat's compensation seen from s; minus infinity for a disc that is seen edge-on.
__device__ inline float log2_compensation(const Compensation<float>& c, float s, float S) {
  return 0.5f * log2f(unfiltered(c, s) / S);
}

// How cameras project: in float, in double (see Cameras::exact), or by a rolling shutter in double.
enum class Way { kFast, kExact, kRolling };

inline Way way_of(const Cameras<float>& cameras) {
  return cameras.rolls() ? Way::kRolling : cameras.exact() ? Way::kExact : Way::kFast;
}

// The splat of a Gaussian in an image, `camera` its camera.
template <Way kWay>
__device__ Splat<float> projected(const Cameras<float>& cameras, int64_t image, const Camera<float>& camera,
                                  const Shape<float>& shape) {
  if constexpr (kWay == Way::kFast) return Projection<float>(camera, shape).splat(camera, shape.opacity);
  const Camera<double> exact = cameras.camera<double>(image);
  if constexpr (kWay == Way::kRolling)
    return splat_cast<float>(CurvedProjection<double, true>(exact, widened(shape)).splat(shape.opacity));
  Compensation<double> of_one_camera;  // not needed: with one camera it is in the opacity
  return splat_cast<float>(lfgs::projected<false>(exact, widened(shape), of_one_camera));
}

// Where the camera of an image stands when it reads a mean, or always.
template <Way kWay>
__device__ glm::vec3 eye_of(const Cameras<float>& cameras, int64_t image, const Camera<float>& camera,
                            const glm::vec3& mean) {
  if constexpr (kWay == Way::kRolling) return glm::vec3(lfgs::eye_of(cameras.camera<double>(image), glm::dvec3(mean)));
  return camera.centre();
}

// Write a colour for one camera, not below zero.
__device__ inline void store_colour(const glm::vec3& colour, float* colours, int64_t index) {
  reinterpret_cast<float4*>(colours)[index] =
      make_float4(fmaxf(colour.x, 0), fmaxf(colour.y, 0), fmaxf(colour.z, 0), 0);
}

}  // namespace lfgs::cuda
