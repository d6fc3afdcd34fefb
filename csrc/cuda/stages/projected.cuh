// How the stages of ordinary images project one Gaussian: project, and its backward pass, which projects once more
// rather than have all splats kept.
#pragma once

#include "cuda/common/compensated.cuh"
#include "math/projection.h"
#include "stages/stages.h"

namespace lfgs::cuda {

// The splat of a Gaussian in an image, `camera` its camera. It is in float, but in double where it is compensated.
template <bool kCompensated>
__device__ Splat<float> projected(const Cameras<float>& cameras, int64_t image, const Camera<float>& camera,
                                  const Shape<float>& shape) {
  if constexpr (kCompensated) {
    Compensation<float> of_one_camera;  // not needed: with one camera it is in the opacity
    return compensated_splat(cameras.camera<double>(image), shape, of_one_camera);
  } else {
    return Projection<float>(camera, shape).splat(camera, shape.opacity);
  }
}

}  // namespace lfgs::cuda
