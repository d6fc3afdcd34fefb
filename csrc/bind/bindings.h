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

// Python has one type for the inputs and the outputs of a stage.
template <class T>
Gaussians<const T> read_only(const Gaussians<T>& g) {
  return {g.count, g.sh_degree, g.means, g.quaternions, g.scales, g.opacities, g.sh};
}
template <class T>
Images<const T> read_only(const Images<T>& i) {
  return {i.image, i.alpha, i.depth};
}

// The parts of the Python module, in the order in which they are bound: functions follow the types that they take.
void bind_types(pybind11::module_ root);
void bind_sorted_types(pybind11::module_ root);
void bind_cpu(pybind11::module_ root);
void bind_features(pybind11::module_ root);
void bind_sorted(pybind11::module_ root);
void bind_fit(pybind11::module_ root);
void bind_photo(pybind11::module_ root);
void bind_weave(pybind11::module_ root);
#ifdef LFGS_WITH_CUDA
void bind_cuda(pybind11::module_ cuda);
void bind_features_cuda(pybind11::module_ cuda);
void bind_frame(pybind11::module_ cuda);
void bind_sorted_cuda(pybind11::module_ cuda);
void bind_fit_cuda(pybind11::module_ cuda);
void bind_photo_cuda(pybind11::module_ cuda);
void bind_png_cuda(pybind11::module_ cuda);
#endif

}  // namespace lfgs
