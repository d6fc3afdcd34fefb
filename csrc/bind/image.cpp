// Binds what writing an image file takes.
#include "stages/image.h"

#include "bind/addresses.h"
#include "bind/parts.h"

namespace py = pybind11;

namespace lfgs {

void bind_image(py::module_ root) {
  // Bytes that Python reads where they are: to copy them would hold up all other threads
  py::class_<std::vector<uint8_t>>(root, "Bytes", py::buffer_protocol()).def_buffer([](std::vector<uint8_t>& bytes) {
    return py::buffer_info(bytes.data(), static_cast<py::ssize_t>(bytes.size()), true);
  });
  root.def(
      "png_stream",
      [](Address pixels, int64_t rows, int64_t row_bytes) { return png_stream(at<uint8_t>(pixels), rows, row_bytes); },
      NoGil(), py::arg("pixels"), py::arg("rows"), py::arg("row_bytes"));
}

}  // namespace lfgs
