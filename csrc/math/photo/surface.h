// Where the sheet over a photo lies on the network's grid: at the average depth of the cloud from the photo's camera.
// The cloud before it fades. lightfield_gs/models/detail.py has the reasons, and the same in differentiable form.
// Between the steps here, each of a Gaussian or a pixel, planes are blurred along rows and along columns.
#pragma once

#include <cmath>
#include <cstdint>
#include <glm/glm.hpp>

#include "base/config.h"
#include "math/constants.h"
#include "math/covariance.h"
#include "math/photo/blur.h"
#include "scene/gaussians.h"

namespace lfgs {

// The choices of lightfield_gs/models/detail.py; lengths in pixels or footprints.
struct SurfaceLook {
  float averaged;    // the deviation of the blur
  float softness;    // depth over which the cloud before the sheet fades
  float solid;       // optical depth of the cloud above which it becomes more opaque, and below which less
  float most_solid;  // the factor of its optical depths at most; of the first layer, which is in the sheet, it is 1
  float shrunk;      // the factor of the lengths of all layers but the first
  float back;        // depth by which they go back
};

struct Surface {
  int64_t height = 0, width = 0;
  int layers = 1;
  Gaussians<float> cloud;             // [layers * height * width]; its opacities fade
  const float* mask = nullptr;        // [height, width]
  const float* intrinsics = nullptr;  // [4] fx, fy, cx, cy in pixels
  SurfaceLook look;
  float* planes = nullptr;     // [3, most_planes(), height, width]: three sets, see plane()
  float* disparity = nullptr;  // [height, width] 1 / z
  float* harmonics = nullptr;  // [rest(), height, width] beyond the first

  LFGS_HD int64_t pixels() const { return height * width; }
  LFGS_HD int rest() const { return 3 * (cloud.sh_count() - 1); }
  LFGS_HD int fog_planes() const { return 3 * layers; }   // size, and size times off() and its square, of a layer
  LFGS_HD int seen_planes() const { return 2 + rest(); }  // disparity, harmonics and one, each times how much is seen
  LFGS_HD int most_planes() const { return fog_planes() > seen_planes() ? fog_planes() : seen_planes(); }
  // A Gaussian's disparity less that in the middle of the photo: what differs little from zero keeps the digits of its
  // spread.
  LFGS_HD float off(int64_t i) const {
    return 1 / cloud.means[3 * i + 2] - 1 / cloud.means[3 * (height / 2 * width + width / 2) + 2];
  }
  LFGS_HD float* plane(int set, int number) const { return planes + (set * most_planes() + number) * pixels(); }
};

// The integral over the photo of a Gaussian of height 1, in pixels.
LFGS_HD float projected_area(const Gaussians<float>& cloud, int64_t i, float focal) {
  const float *p = cloud.means + 3 * i, *q = cloud.quaternions + 4 * i, *s = cloud.scales + 3 * i;
  const glm::vec4 turn(q[0], q[1], q[2], q[3]);
  const glm::mat3 axes = rotation_matrix(turn / std::sqrt(glm::dot(turn, turn)));
  // The change of the slopes x / z and y / z by a standard deviation along each axis
  glm::vec3 across, down;
  for (int k = 0; k < 3; ++k) {
    across[k] = s[k] * (axes[k].x - p[0] / p[2] * axes[k].z);
    down[k] = s[k] * (axes[k].y - p[1] / p[2] * axes[k].z);
  }
  const float both = glm::dot(across, down);
  const float determinant = glm::dot(across, across) * glm::dot(down, down) - both * both;
  const float per_pixel = focal / p[2];
  return 2 * float(kPi) * std::sqrt(glm::max(determinant, 1e-20f)) * per_pixel * per_pixel;
}

// Write the fog of a Gaussian of a layer to set 0.
LFGS_HD void weigh(const Surface& job, int layer, int64_t pixel) {
  const int64_t i = layer * job.pixels() + pixel;
  const float area = projected_area(job.cloud, i, job.intrinsics[0]), off = job.off(i);
  const float size = job.cloud.opacities[i] * area * job.mask[pixel] + 1e-9f;
  job.plane(0, 3 * layer)[pixel] = size;
  job.plane(0, 3 * layer + 1)[pixel] = size * off;
  job.plane(0, 3 * layer + 2)[pixel] = size * off * off;
}

// A blurred number of a plane: number `at` of `count` along the blur, with neighbours `stride` apart.
template <class Weight>
LFGS_HD float blurred_at(const float* number, int64_t stride, int64_t at, int64_t count, int reach,
                         const Weight& weight) {
  float sum = 0;
  for (int k = -reach; k <= reach; ++k)
    if (at + k >= 0 && at + k < count) sum += weight(k) * number[k * stride];
  return sum;
}

constexpr float kMostOfCloud = 0.999f;  // opacity of a Gaussian, whose logarithm is taken

// Write the visibility of a pixel's Gaussians and their averages to set 1, and make the Gaussians more solid. Set 2 has
// the blurred fog, set 0 the sizes. A nearer Gaussian has a larger disparity; the fog's density is a normal
// distribution along the line of sight.
LFGS_HD void look_through(const Surface& job, int64_t pixel) {
  const int rest = job.rest(), last = job.seen_planes() - 1;
  for (int c = 0; c <= last; ++c) job.plane(1, c)[pixel] = 0;
  float thickness = 0;
  for (int layer = 0; layer < job.layers; ++layer) thickness += job.plane(2, 3 * layer)[pixel];
  const float relative = thickness / job.look.solid, gain = glm::min(relative * relative, job.look.most_solid);
  for (int layer = 0; layer < job.layers; ++layer) {
    const int64_t i = layer * job.pixels() + pixel;
    const float off = job.off(i);
    float before = 0;
    for (int other = 0; other < job.layers; ++other) {
      const float thick = job.plane(2, 3 * other)[pixel], mean = job.plane(2, 3 * other + 1)[pixel] / thick;
      const float square = job.plane(2, 3 * other + 2)[pixel] / thick;
      const float spread = std::sqrt(glm::max(square - mean * mean, 1e-8f));
      before += thick * 0.5f * std::erfc((off - mean) / spread * 0.70710678f);
    }
    const float seen = job.plane(0, 3 * layer)[pixel] * std::exp(-before);
    job.plane(1, 0)[pixel] += seen / job.cloud.means[3 * i + 2];
    for (int c = 0; c < rest; ++c) job.plane(1, 1 + c)[pixel] += seen * job.cloud.sh[i * (rest + 3) + 3 + c];
    job.plane(1, last)[pixel] += seen;
    float& opacity = job.cloud.opacities[i];  // the sizes in set 0 have the one before
    opacity = -std::expm1((layer == 0 ? glm::min(gain, 1.f) : gain) * std::log1p(-glm::min(opacity, kMostOfCloud)));
  }
}

LFGS_HD float logistic(float x) { return 1 / (1 + std::exp(-x)); }

// Write the surface of a pixel, from the visible average in set 0, and move, shrink and fade its Gaussians.
LFGS_HD void finish_surface(const Surface& job, int64_t pixel) {
  const float seen = job.plane(0, job.seen_planes() - 1)[pixel], footprint = 1 / job.intrinsics[0];
  const float disparity = job.plane(0, 0)[pixel] / seen;
  job.disparity[pixel] = disparity;
  for (int c = 0; c < job.rest(); ++c) job.harmonics[c * job.pixels() + pixel] = job.plane(0, 1 + c)[pixel] / seen;
  for (int layer = 0; layer < job.layers; ++layer) {
    const int64_t i = layer * job.pixels() + pixel;
    const float farther = layer == 0 ? 1.f : 1 + job.look.back * footprint;
    const float larger = layer == 0 ? 1.f : farther * job.look.shrunk;
    for (int k = 0; k < 3; ++k) job.cloud.means[3 * i + k] *= farther;
    for (int k = 0; k < 3; ++k) job.cloud.scales[3 * i + k] *= larger;
    const float behind = (job.cloud.means[3 * i + 2] * disparity - 1) / footprint;
    const float hidden = job.mask[pixel] * logistic(-behind / job.look.softness);
    job.cloud.opacities[i] = glm::clamp(job.cloud.opacities[i] * (1 - hidden), 0.f, 1.f);
  }
}

}  // namespace lfgs
