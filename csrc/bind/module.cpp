// The Python module: integers become pointers, and an Error becomes a ValueError. It knows neither torch nor NumPy;
// Python owns every buffer and checks every argument before it hands addresses over. The GIL is released while a stage
// runs.
#include <pybind11/pybind11.h>

#include "base/error.h"
#include "bind/bindings.h"

namespace py = pybind11;

PYBIND11_MODULE(_core, m) {
  using namespace lfgs;
  m.doc() = "Native core of lightfield_gs; use lightfield_gs.rasterizer.ops instead.";
  py::register_exception_translator([](std::exception_ptr p) {
    try {
      if (p) std::rethrow_exception(p);
    } catch (const Error& e) {
      PyErr_SetString(PyExc_ValueError, e.what());
    }
  });
  m.attr("version") = LFGS_VERSION;
  m.def_submodule("float32");
  m.def_submodule("float64");
  bind_types(m);
  bind_sorted_types(m);
  bind_cpu(m);
  bind_features(m);
  bind_sorted(m);
  bind_fit(m);
  bind_photo(m);
  bind_weave(m);
#ifdef LFGS_WITH_CUDA
  py::module_ cuda = m.def_submodule("cuda");
  bind_cuda(cuda);
  bind_frame(cuda);
  bind_features_cuda(cuda);
  bind_sorted_cuda(cuda);
  bind_fit_cuda(cuda);
  bind_photo_cuda(cuda);
  bind_png_cuda(cuda);
#endif
}
