// The noise of MCMC on positions (Kheradmand et al., "3D Gaussian splatting as Markov chain Monte Carlo", NeurIPS 2024,
// eq. 8 and 9): along the Gaussian's own covariance, and only for those that are nearly transparent.
#pragma once

#include "math/covariance.h"
#include "math/fit/activation.h"
#include "math/fit/normal.h"

namespace lfgs {

constexpr double kNoiseSteepness = 100, kNoiseOpacity = 0.005;

// Sigma z sigmoid(100 (0.005 - opacity)) strength, for normal z. The quaternion has any length but zero; of a Gaussian
// whose quaternion is zero the noise is zero, for it has no directions.
template <class R>
LFGS_HD glm::vec<3, R> position_noise(const RandomStream& stream, uint64_t index, glm::vec<4, R> quaternion,
                                      const glm::vec<3, R>& scale, R opacity, R strength) {
  R z[4];
  normals4(stream, index, z);
  const R length = std::sqrt(glm::dot(quaternion, quaternion));
  if (!(length > 0)) return glm::vec<3, R>(0);
  const glm::mat<3, 3, R> axes = rotation_matrix(quaternion / length);
  glm::vec<3, R> along = glm::vec<3, R>(z[0], z[1], z[2]) * axes;  // components along the axes of the Gaussian
  along *= scale * scale * (strength * sigmoid(R(kNoiseSteepness) * (R(kNoiseOpacity) - opacity)));
  return axes * along;
}

}  // namespace lfgs
