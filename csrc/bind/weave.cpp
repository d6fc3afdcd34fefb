// Bind the stage that weaves pictures of views into the image of a panel.
#include "stages/weave.h"

#include "bind/bindings.h"

namespace py = pybind11;

namespace lfgs {
namespace {

template <class T>
void bind_type(py::module_ root, const char* name) {
  root.def(
      name,
      [](Address pixels, int64_t first, int64_t own, int64_t held, int64_t height_px, int64_t width_px,
         const WeaveWindow& window, const WeaveFan& fan, Address out, int threads) {
        weave<T>({at<T>(pixels), first, own, held, height_px, width_px}, window, fan, at<T>(out), threads);
      },
      NoGil(), py::arg("pixels"), py::arg("first"), py::arg("own"), py::arg("held"), py::arg("height_px"),
      py::arg("width_px"), py::arg("window"), py::arg("fan"), py::arg("out"), py::arg("threads"));
}

}  // namespace

void bind_weave(py::module_ root) {
  py::class_<WeaveWindow>(root, "WeaveWindow")
      .def(py::init([](double left, double top, double width, double height, double low_x, double low_y, double high_x,
                       double high_y, double shift) {
             return WeaveWindow{left, top, width, height, low_x, low_y, high_x, high_y, shift};
           }),
           py::kw_only(), py::arg("left"), py::arg("top"), py::arg("width"), py::arg("height"), py::arg("low_x"),
           py::arg("low_y"), py::arg("high_x"), py::arg("high_y"), py::arg("shift"));
  py::class_<WeaveFan>(root, "WeaveFan")
      .def(py::init([](const ViewMap& map, Address places, bool continuous, bool inverted, int64_t views, double box) {
             return WeaveFan{map, at<double>(places), continuous, inverted, views, box};
           }),
           py::arg("map"), py::arg("places"), py::arg("continuous"), py::arg("inverted"), py::arg("views"),
           py::arg("box"));
  bind_type<uint8_t>(root, "weave_uint8");
  bind_type<uint16_t>(root, "weave_uint16");
  bind_type<float>(root, "weave_float32");
}

}  // namespace lfgs
