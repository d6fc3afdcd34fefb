// What composite reads and writes for the panel, in both directions. composite_direct.cpp fills one DirectJob for an
// image, and all workers read it.
#pragma once

#include <vector>

#include "stages/stages.h"
#include "base/parallel.h"
#include "math/footprint.h"
#include "math/inverse_root.h"

namespace lfgs {

template <class T>
struct DirectJob {
  Splats<T> splats;
  Bins bins;
  const Lens* lens;
  Quality quality;
  const T* background;  // [3]
  T* out;               // the image, [H, W, 3], is written here, or as bytes to out8; the other is null
  uint8_t* out8;
  const T *image, *gradient;  // backward pass only: the image that was drawn, and the gradient of the loss by it
  const int64_t* first_intersection;
  T *intersection_gradients, *band_background;
  bool backward;  // the direction; intersection_gradients cannot tell, for it is also null where no splat is drawn
  int threads;
};

// In floats it fills one line of the cache.
template <class T>
struct alignas(16 * sizeof(T)) TileSplat {
  Splat<T> splat;
  InverseRoot<T> root;
};

template <class T>
class TileSplats {
 public:
  // raise: whether the opacity cut is still to be raised, since projection left it at 1/255 for lattices.
  TileSplats(const Splats<T>& splats, const Quality& quality, bool raise, int threads) : all_(size_t(splats.count)) {
    parallel_for_chunks(splats.count, kGrain, threads, [&](int64_t begin, int64_t end, int) {
      for (int64_t i = begin; i < end; ++i) {
        TileSplat<T>& to = all_[size_t(i)];
        to.splat = splats.splats[i];
        if (to.splat.reach_y < 0) continue;
        if (raise) raise_cut(to.splat, T(quality.log2_cut), quality.approximate());
        to.root = InverseRoot<T>(to.splat);
      }
    });
  }

  const TileSplat<T>& operator[](int32_t id) const { return all_[size_t(id)]; }
  int64_t bytes() const { return int64_t(all_.size() * sizeof(TileSplat<T>)); }

 private:
  static constexpr int64_t kGrain = 4096;
  std::vector<TileSplat<T>> all_;
};

}  // namespace lfgs
