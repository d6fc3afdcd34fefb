// Binds the stages of fitting on a CUDA device. Streams and all pointers are integers, as on the CPU.
#include <pybind11/pybind11.h>

#include "bind/addresses.h"
#include "bind/parts.h"
#include "cuda/fit/fit.h"

namespace py = pybind11;

namespace lfgs {

void bind_fit_cuda(py::module_ cuda) {
  cuda.def("photo_loss_partials", &cuda::photo_loss_partials, py::arg("images"), py::arg("height_px"),
           py::arg("width_px"));
  cuda.def(
      "photo_loss", [](const PhotoLoss<float>& job, Address stream) { cuda::photo_loss(job, at<void>(stream)); },
      NoGil(), py::arg("job"), py::arg("stream"));
  cuda.def(
      "update", [](const Update<float>& job, Address stream) { cuda::update(job, at<void>(stream)); }, NoGil(),
      py::arg("job"), py::arg("stream"));
  cuda.def(
      "uniforms",
      [](uint64_t seed, uint32_t step, uint32_t purpose, int64_t count, Address out, Address stream) {
        cuda::uniforms({seed, step, purpose}, count, at<double>(out), at<void>(stream));
      },
      NoGil(), py::arg("seed"), py::arg("step"), py::arg("purpose"), py::arg("count"), py::arg("out"),
      py::arg("stream"));
  cuda.def(
      "normals",
      [](uint64_t seed, uint32_t step, uint32_t purpose, int64_t count, Address out, Address stream) {
        cuda::normals({seed, step, purpose}, count, at<float>(out), at<void>(stream));
      },
      NoGil(), py::arg("seed"), py::arg("step"), py::arg("purpose"), py::arg("count"), py::arg("out"),
      py::arg("stream"));
  cuda.def(
      "dropout", [](const Dropout<float>& job, Address stream) { cuda::dropout(job, at<void>(stream)); }, NoGil(),
      py::arg("job"), py::arg("stream"));
}

}  // namespace lfgs
