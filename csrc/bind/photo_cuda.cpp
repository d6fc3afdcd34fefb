// Binds the stages that lay a photo over what the network predicts, on a CUDA device.
#include <pybind11/pybind11.h>

#include "bind/addresses.h"
#include "bind/parts.h"
#include "cuda/photo/crop.h"
#include "cuda/photo/photo.h"

namespace py = pybind11;

namespace lfgs {

void bind_photo_cuda(py::module_ cuda) {
  cuda.def(
      "surface", [](const Surface& job, Address stream) { cuda::surface(job, at<void>(stream)); }, NoGil(),
      py::arg("job"), py::arg("stream"));
  cuda.def(
      "sheet", [](const Sheet& job, Address stream) { cuda::sheet(job, at<void>(stream)); }, NoGil(), py::arg("job"),
      py::arg("stream"));
  cuda.attr("FOUND_NUMBERS") = cuda::kFoundNumbers;
  py::class_<cuda::Photo>(cuda, "Photo")
      .def(py::init([](int64_t height, int64_t width, Address bytes, Address floats, float opaque, double margin,
                       Address found, Address checks) {
             return cuda::Photo{height, width,  at<uint8_t>(bytes),  at<float>(floats),
                                opaque, margin, at<unsigned>(found), at<float>(checks)};
           }),
           py::kw_only(), py::arg("height"), py::arg("width"), py::arg("bytes"), py::arg("floats"), py::arg("opaque"),
           py::arg("margin"), py::arg("found"), py::arg("checks"));
  cuda.def(
      "find_object", [](const cuda::Photo& photo, Address stream) { cuda::find_object(photo, at<void>(stream)); },
      NoGil(), py::arg("photo"), py::arg("stream"));
  cuda.def(
      "crop_object",
      [](const cuda::Photo& photo, int size_px, Address narrow, Address out, Address stream) {
        cuda::crop_object(photo, size_px, at<float>(narrow), at<float>(out), at<void>(stream));
      },
      NoGil(), py::arg("photo"), py::arg("size_px"), py::arg("narrow"), py::arg("out"), py::arg("stream"));
}

}  // namespace lfgs
