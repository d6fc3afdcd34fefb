// How Python hands over buffers: as integers, which become pointers here. Python checks sizes and types before.
#pragma once

#include <pybind11/pybind11.h>

#include <cstdint>

#include "scene/gaussians.h"
#include "stages/stages.h"

namespace lfgs {

using Address = uintptr_t;
using NoGil = pybind11::call_guard<pybind11::gil_scoped_release>;

template <class T>
T* at(Address address) {
  return reinterpret_cast<T*>(address);
}

// Python has one type for what a stage reads and what it writes.
template <class T>
Gaussians<const T> read_only(const Gaussians<T>& g) {
  return {g.count, g.sh_degree, g.means, g.quaternions, g.scales, g.opacities, g.sh};
}
template <class T>
Images<const T> read_only(const Images<T>& i) {
  return {i.image, i.alpha, i.depth};
}

}  // namespace lfgs
