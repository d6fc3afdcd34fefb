// Splats as the tiles of the panel read them. Many tiles read the same splat, so what does not depend on the tile is
// worked out once for an image: the raised opacity cut, and the parabola that stands for S^(-1/2).
#pragma once

#include <vector>

#include "base/parallel.h"
#include "math/footprint.h"
#include "math/inverse_root.h"
#include "stages/stages.h"

namespace lfgs {

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
