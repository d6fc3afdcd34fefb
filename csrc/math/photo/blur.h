// Convolution with a Gaussian, a sample at a time.
#pragma once

#include <cmath>
#include <vector>

#include "base/config.h"

namespace lfgs {

// The weights of the samples -reach..reach; they add up to one.
struct Blur {
  float deviation = 1;  // samples
  int reach = 0;
  float scale = 1;

  static Blur of(float deviation) {
    Blur blur{deviation, int(std::ceil(3 * deviation)), 1};
    double sum = 0;
    for (int k = -blur.reach; k <= blur.reach; ++k) sum += double(blur.weight(k));
    blur.scale = float(1 / sum);
    return blur;
  }
  LFGS_HD float weight(int k) const {
    const float place = float(k) / deviation;
    return scale * std::exp(-0.5f * place * place);
  }
};

class BlurWeights {
 public:
  // deviation: of the blur.
  explicit BlurWeights(float deviation) : BlurWeights(Blur::of(deviation)) {}
  explicit BlurWeights(const Blur& blur) : reach_(blur.reach) {
    for (int k = -reach_; k <= reach_; ++k) weights_.push_back(blur.weight(k));
  }

  int reach() const { return reach_; }
  // The weight of the k-th neighbour, -reach() to reach().
  float operator()(int k) const { return weights_[size_t(k + reach_)]; }

 private:
  int reach_;
  std::vector<float> weights_;
};

}  // namespace lfgs
