// The inputs and outputs of composite for the panel, in both directions. composite_direct.cpp fills one DirectJob for
// an image, and all workers read it.
#pragma once

#include "math/projection.h"
#include "base/config.h"
#include <cmath>
#include <vector>

#include "stages/stages.h"
#include "base/parallel.h"
#include "math/footprint.h"

namespace lfgs {

constexpr double kMostRootError = 4e-5;  // relative; alpha errs by less than 0.74 of it, which keeps 80 dB at 8 bits

// S(s)^(-1/2) as a parabola over the rig, which saves every sample a division.
//   S^(-1/2) ~ r0 + r1 s + r2 s^2   for s in [-1, 1].
// With S = S0 (1 + a1 s + a2 s^2) it is a power series up to s^4. The nearest polynomials of lower order, 3/4 s and
// s^2 - 1/8, replace s^3 and s^4 (Chebyshev's economization).
template <class T>
struct InverseRoot {
  T r0 = 0, r1 = 0, r2 = 0;
  T error = 1;  // about the largest relative error

  InverseRoot() = default;
  LFGS_HD explicit InverseRoot(const Splat<T>& s) {
    const T inverse = 1 / s.S0, root = std::sqrt(inverse), a1 = s.S1 * inverse, a2 = s.S2 * inverse, square = a1 * a1;
    const T p1 = T(-0.5) * a1, p2 = T(0.375) * square - T(0.5) * a2;
    const T p3 = a1 * (T(0.75) * a2 - T(0.3125) * square);
    const T p4 = T(0.2734375) * square * square - T(0.9375) * square * a2 + T(0.375) * a2 * a2;
    r0 = root * (1 - p4 / 8), r1 = root * (p1 + T(0.75) * p3), r2 = root * (p2 + p4);
    error = std::fabs(p3) / 4 + std::fabs(p4) / 8;
    // Where S varies much the terms left out are too large for this estimate
    if (!(std::fabs(a1) + std::fabs(a2) <= T(0.5))) error = 1;
  }
};

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
  T* g_offsets;   // [H, W, 3], or null: the gradients of the samples' offsets s
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
