// The weights of a blur, which each pixel needs again.
#pragma once

#include <vector>

#include "math/photo/blur.h"

namespace lfgs {

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
