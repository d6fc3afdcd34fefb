// The parts of the Python module, in the order in which they are bound: functions follow the types that they take.
#pragma once

#include <pybind11/pybind11.h>

namespace lfgs {

void bind_types(pybind11::module_ root);
void bind_sorted_types(pybind11::module_ root);
void bind_cpu(pybind11::module_ root);
void bind_sorted(pybind11::module_ root);
void bind_fit(pybind11::module_ root);
void bind_photo(pybind11::module_ root);
void bind_weave(pybind11::module_ root);
#ifdef LFGS_WITH_CUDA
void bind_cuda(pybind11::module_ cuda);
void bind_frame(pybind11::module_ cuda);
void bind_sorted_cuda(pybind11::module_ cuda);
void bind_fit_cuda(pybind11::module_ cuda);
void bind_photo_cuda(pybind11::module_ cuda);
void bind_png_cuda(pybind11::module_ cuda);
#endif

}  // namespace lfgs
