// Bind the frame, a light-field image that CUDA draws without the host in between. See cuda/frame/direct_frame.h and
// lightfield_gs/rasterizer/frame_cuda.py.
#include "cuda/frame/direct_frame.h"

#include <pybind11/stl.h>

#include <bit>

#include "base/error.h"
#include "bind/bindings.h"

namespace py = pybind11;

namespace lfgs {
namespace {

using cuda::DirectFrame;
using cuda::FrameKernel;
using cuda::FrameState;

// Make a frame use this kernel; -1 lets it choose.
void force(DirectFrame& frame, int kernel) {
  require(kernel >= -1 && kernel < int(FrameKernel::kCount), "no such kernel: " + std::to_string(kernel));
  require(kernel != int(FrameKernel::kLensColumn) || frame.has_lens_column(),
          "the lens-column kernel cannot draw this lens on this device");
  require(!frame.rig.compensated() || (kernel != int(FrameKernel::kPixel) && kernel != int(FrameKernel::kPixelSmall)),
          "frames of compensated opacities are drawn by pixel-quadratic, pixel-quadratic-small or lens-column");
  frame.forced = kernel;
}

// The results of a frame, read from a copy of its state in host memory.
py::dict frame_state(Address address) {
  const FrameState& state = *at<FrameState>(address);
  py::dict out;
  out["intersections"] = state.intersections;
  out["drawn"] = state.drawn;
  out["colour_error"] = std::bit_cast<float>(state.colour_error);
  out["kernel"] = state.choice.kernel;
  out["exact"] = state.choice.needs_exact < 0;
  out["bent_colours"] = state.bent_colours;
  out["curved"] = state.curved;
  out["lattice_tiles"] = state.lattice_tiles;
  out["refused_tiles"] = state.refused_tiles;
  out["tried_tiles"] = state.tried_tiles;
  out["pruned"] = state.pruned;
  return out;
}

void bind_stages(py::module_ m) {
  m.def(
      "frame_project",
      [](const DirectFrame& frame, const Gaussians<float>& gaussians, bool keep_lists, Address stream) {
        cuda::frame_project(frame, read_only(gaussians), keep_lists, at<void>(stream));
      },
      NoGil(), py::arg("frame"), py::arg("gaussians"), py::arg("keep_lists"), py::arg("stream"));
  m.def(
      "frame_bin", [](const DirectFrame& frame, Address stream) { cuda::frame_bin(frame, at<void>(stream)); }, NoGil(),
      py::arg("frame"), py::arg("stream"));
  m.def(
      "frame_order", [](const DirectFrame& frame, Address stream) { cuda::frame_order(frame, at<void>(stream)); },
      NoGil(), py::arg("frame"), py::arg("stream"));
  m.def(
      "frame_composite",
      [](const DirectFrame& frame, Address background, Address out, Address out8, Address stream) {
        cuda::frame_composite(frame, at<float>(background), at<float>(out), at<uint8_t>(out8), at<void>(stream));
      },
      NoGil(), py::arg("frame"), py::arg("background"), py::arg("out"), py::arg("out8"), py::arg("stream"));
}

}  // namespace

void bind_frame(py::module_ cuda) {
  cuda.attr("FRAME_STATE_BYTES") = sizeof(FrameState);
  cuda.attr("FRAME_KERNELS") =
      std::vector<std::string>{"pixel", "pixel-quadratic", "pixel-small", "pixel-quadratic-small", "lens-column"};
  py::class_<DirectFrame>(cuda, "DirectFrame")
      .def(py::init<int64_t, int, int, const Camera<double>&, const Lens&, int64_t, const Quality&, double, double,
                    int64_t>(),
           py::kw_only(), py::arg("gaussians"), py::arg("sh_degree"), py::arg("colour_order"), py::arg("rig"),
           py::arg("lens"), py::arg("capacity"), py::arg("quality"), py::arg("colour_error"), py::arg("left_out"),
           py::arg("shared_memory"))
      .def("bytes", [](DirectFrame frame) { return frame.place(nullptr); })
      .def(
          "place", [](DirectFrame& frame, Address work) { return frame.place(at<void>(work)); }, py::arg("work"))
      .def("state_address", [](const DirectFrame& frame) { return reinterpret_cast<Address>(frame.state); })
      .def("force", &force, py::arg("kernel"))
      .def_property_readonly("lens_column_layout", [](const DirectFrame& frame) {
        constexpr const char* kNames[] = {"none", "compact", "full"};
        return kNames[int(frame.lens_column_layout)];
      });
  cuda.def("frame_state", &frame_state, py::arg("address"));
  bind_stages(cuda);
}

}  // namespace lfgs
