// A set of 3D Gaussians, or its gradients: plain pointers to memory that the caller owns.
#pragma once

#include <cstdint>

#include "base/config.h"

namespace lfgs {

// Row-major arrays of `count` Gaussians; T is const float/double for values, float/double for gradients.
template <class T>
struct Gaussians {
  int64_t count = 0;
  int sh_degree = 0;         // 0..3
  T* means = nullptr;        // [count, 3] scene units
  T* quaternions = nullptr;  // [count, 4] wxyz, normalized by the reader
  T* scales = nullptr;       // [count, 3] standard deviations, scene units
  T* opacities = nullptr;    // [count] (0, 1]
  T* sh = nullptr;           // [count, (sh_degree + 1)^2, 3]

  LFGS_HD int sh_count() const { return (sh_degree + 1) * (sh_degree + 1); }

  // The set that starts `first` Gaussians later (scene b of a batch: slice(b * count)).
  LFGS_HD Gaussians slice(int64_t first) const {
    Gaussians s = *this;
    s.means += 3 * first;
    s.quaternions += 4 * first;
    s.scales += 3 * first;
    s.opacities += first;
    s.sh += 3 * sh_count() * first;
    return s;
  }
};

}  // namespace lfgs
