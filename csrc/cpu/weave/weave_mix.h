// Which of M views a sub-pixel mixes, and how much of each.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <vector>

#include "stages/weave.h"

namespace lfgs {

// Views first .. first + count - 1; weights sum to 1.
struct WeaveMix {
  int64_t first = 0, count = 0;
  const float* weights = nullptr;
};

// How many views a box touches at most.
inline int64_t most_mixed(const WeaveFan& fan) { return std::min(fan.views, int64_t(std::ceil(fan.box)) + 1); }

// Each view stands for the places nearer to it than to another, and the outermost for all beyond: its share is how much
// of the box around `place` is its. A box of one view is linear interpolation. weights [most_mixed].
inline WeaveMix mix_at(const WeaveFan& fan, double place, float* weights) {
  const int64_t last = fan.views - 1;
  const auto view_of = [&](double x) { return std::clamp(int64_t(x), int64_t(0), last); };
  if (fan.box == 0) return weights[0] = 1, WeaveMix{view_of(std::floor(place + 0.5)), 1, weights};
  const double low = place - fan.box / 2, high = place + fan.box / 2;
  const int64_t first = view_of(std::floor(low + 0.5));
  const int64_t end = std::min(view_of(std::ceil(high + 0.5) - 1) + 1, first + most_mixed(fan));
  for (int64_t view = first; view < end; ++view) {
    const double from = view == 0 ? low : std::max(low, double(view) - 0.5);
    const double to = view == last ? high : std::min(high, double(view) + 0.5);
    weights[view - first] = float(std::max(0.0, to - from) / fan.box);
  }
  return {first, end - first, weights};
}

// The mixes of all of a panel's views; made once.
class WeaveMixes {
 public:
  explicit WeaveMixes(const WeaveFan& fan) : weights_(size_t(fan.map.views * most_mixed(fan))) {
    mixes_.reserve(size_t(fan.map.views));
    for (int64_t view = 0; view < fan.map.views; ++view)
      mixes_.push_back(mix_at(fan, fan.places[view], weights_.data() + view * most_mixed(fan)));
  }
  const WeaveMix& operator[](int64_t view) const { return mixes_[size_t(view)]; }

 private:
  std::vector<float> weights_;
  std::vector<WeaveMix> mixes_;
};

}  // namespace lfgs
