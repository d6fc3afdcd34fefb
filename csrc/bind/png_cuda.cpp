// Binds what compresses images for PNG files on a CUDA device.
#include <pybind11/pybind11.h>

#include "bind/addresses.h"
#include "bind/parts.h"
#include "cuda/png/png.h"

namespace py = pybind11;

namespace lfgs {

void bind_png_cuda(py::module_ cuda) {
  cuda.attr("DEFLATE_FACTS_BYTES") = sizeof(cuda::DeflateFacts);
  py::class_<cuda::PngImage>(cuda, "PngImage")
      .def(py::init([](int64_t height, int64_t width, int64_t channels, Address pixels) {
             return cuda::PngImage{height, width * channels, channels, at<uint8_t>(pixels)};
           }),
           py::kw_only(), py::arg("height"), py::arg("width"), py::arg("channels"), py::arg("pixels"))
      .def("work_bytes", &cuda::PngImage::work_bytes)
      .def("stream_bytes", &cuda::PngImage::stream_bytes)
      .def(
          "place", [](cuda::PngImage& image, Address work, Address out) { image.place(at<void>(work), at<void>(out)); },
          py::arg("work"), py::arg("out"));
  cuda.def(
      "deflate", [](const cuda::PngImage& image, Address stream) { cuda::deflate(image, at<void>(stream)); }, NoGil(),
      py::arg("image"), py::arg("stream"));
}

}  // namespace lfgs
