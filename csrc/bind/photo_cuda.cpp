// Binds the stages that lay a photo over what the network predicts, on a CUDA device.
#include <pybind11/pybind11.h>

#include "bind/addresses.h"
#include "bind/parts.h"
#include "cuda/photo/photo.h"

namespace py = pybind11;

namespace lfgs {

void bind_photo_cuda(py::module_ cuda) {
  cuda.def(
      "sheet", [](const Sheet& job, Address stream) { cuda::sheet(job, at<void>(stream)); }, NoGil(), py::arg("job"),
      py::arg("stream"));
}

}  // namespace lfgs
