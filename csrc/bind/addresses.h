// How Python hands over buffers: as integers.
#pragma once

#include <pybind11/pybind11.h>

#include <cstdint>

namespace lfgs {

using Address = uintptr_t;
using NoGil = pybind11::call_guard<pybind11::gil_scoped_release>;

template <class T>
T* at(Address address) {
  return reinterpret_cast<T*>(address);
}

void bind_lens_frame(pybind11::module_ m);  // of the CUDA backend
void bind_sorted(pybind11::module_ root);   // after the types of module.cpp

}  // namespace lfgs
