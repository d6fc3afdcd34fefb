// The light-field frame of the CUDA backend for Python; see cuda/frame/lens_frame.h and frame_cuda.py.
#include "cuda/frame/lens_frame.h"

#include <pybind11/stl.h>

#include <bit>

#include "base/error.h"
#include "bind/addresses.h"

namespace py = pybind11;

namespace lfgs {

void bind_lens_frame(py::module_ m) {
  using cuda::FrameState;
  using cuda::LensFrame;
  using G = Gaussians<float>;
  m.attr("FRAME_STATE_BYTES") = sizeof(FrameState);
  m.attr("FRAME_KERNELS") =
      std::vector<std::string>{"pixel", "pixel-quadratic", "pixel-small", "pixel-quadratic-small", "ordinal"};
  py::class_<LensFrame>(m, "LensFrame")
      .def(py::init<int64_t, int, int, const View<double>&, const Lens&, int64_t, const Quality&, double>(),
           py::kw_only(), py::arg("gaussians"), py::arg("sh_degree"), py::arg("colour_order"), py::arg("rig"),
           py::arg("lens"), py::arg("capacity"), py::arg("quality"), py::arg("tolerance"))
      .def("bytes", [](LensFrame frame) { return frame.place(nullptr); })
      .def("place", [](LensFrame& frame, Address work) { return frame.place(at<void>(work)); })
      .def("state_address", [](const LensFrame& frame) { return reinterpret_cast<Address>(frame.state); })
      .def("force", [](LensFrame& frame, int kernel) {
        require(kernel >= -1 && kernel < int(cuda::LensKernel::kCount), "no such kernel: " + std::to_string(kernel));
        require(kernel != int(cuda::LensKernel::kOrdinal) || frame.has_ordinal,
                "the ordinal kernel cannot draw this lens on this device");
        require(!frame.rig.antialiased ||
                    (kernel != int(cuda::LensKernel::kPixel) && kernel != int(cuda::LensKernel::kPixelSmall)),
                "anti-aliased frames are drawn by pixel-quadratic, pixel-quadratic-small or ordinal");
        frame.forced = kernel;
      });
  m.def("frame_state", [](Address address) {  // of a copy in host memory
    const FrameState& state = *at<FrameState>(address);
    py::dict out;
    out["pairs"] = state.pairs;
    out["drawn"] = state.drawn;
    out["colour_error"] = std::bit_cast<float>(state.colour_error);
    out["kernel"] = state.kernel;
    out["exact"] = state.careful < 0;
    out["curved"] = state.curved;
    out["lattice_tiles"] = state.lattice_tiles;
    out["refused_tiles"] = state.refused_tiles;
    out["tried_tiles"] = state.tried_tiles;
    out["pruned"] = state.pruned;
    return out;
  });
  m.def(
      "frame_project",
      [](const LensFrame& frame, const G& g, bool keep_lists, Address stream) {
        cuda::frame_project(frame, {g.count, g.sh_degree, g.means, g.quaternions, g.scales, g.opacities, g.sh},
                            keep_lists, at<void>(stream));
      },
      NoGil());
  m.def("frame_bin", [](const LensFrame& frame, Address stream) { cuda::frame_bin(frame, at<void>(stream)); }, NoGil());
  m.def(
      "frame_order", [](const LensFrame& frame, Address stream) { cuda::frame_order(frame, at<void>(stream)); },
      NoGil());
  m.def(
      "frame_composite",
      [](const LensFrame& frame, Address background, Address out, Address out8, Address stream) {
        cuda::frame_composite(frame, at<float>(background), at<float>(out), at<uint8_t>(out8), at<void>(stream));
      },
      NoGil());
}

}  // namespace lfgs
