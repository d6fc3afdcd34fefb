// How the stages of ordinary images project one Gaussian: project, and its reverse, which projects once more rather
// than have all splats kept.
#pragma once

#include "cuda/common/compensated.cuh"
#include "math/projection.h"
#include "stages/stages.h"

namespace lfgs::cuda {

// The splat of a Gaussian in an image, `view` its camera. It is in float, but in double where it is compensated.
template <bool kCompensated>
__device__ Splat<float> projected(const Cameras<float>& cameras, int64_t image, const View<float>& view,
                                  const Shape<float>& shape) {
  if constexpr (kCompensated) {
    Compensation<float> of_one_camera;  // not needed: with one camera it is in the opacity
    return compensated_splat(cameras.view<double>(image), shape, of_one_camera);
  } else {
    return Projection<float>(view, shape).splat(view, shape.opacity);
  }
}

}  // namespace lfgs::cuda
