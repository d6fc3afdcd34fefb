// Bind the types of the functions' arguments: constants, the panel and the rig, and for each precision the structs
// that name buffers.
#include <pybind11/pybind11.h>
#include <pybind11/stl.h>

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <vector>

#include "base/error.h"
#include "bind/bindings.h"
#include "math/footprint.h"
#include "stages/stages.h"

namespace py = pybind11;

namespace lfgs {
namespace {

void bind_constants(py::module_ m) {
  m.attr("BAND_ROWS") = kBandRows;
  m.attr("LOG2_MIN_ALPHA") = kLog2MinAlpha;
  m.attr("SPLAT_FIELDS") = kSplatFields;
  static_assert(offsetof(Splat<float>, reach_y) == kSplatReachIndex * sizeof(float));
  m.attr("SPLAT_REACH_INDEX") = kSplatReachIndex;
  const auto index = [](size_t offset) { return offset / sizeof(float); };
  m.attr("SPLAT_SHAPE_INDICES") =
      py::make_tuple(index(offsetof(Splat<float>, log2_opacity)), index(offsetof(Splat<float>, S0)),
                     index(offsetof(Splat<float>, tau)), index(offsetof(Splat<float>, c0)));
  m.attr("SPLAT_PLACE_INDICES") = py::make_tuple(index(offsetof(Splat<float>, u0)), index(offsetof(Splat<float>, v0)));
  m.attr("SPLAT_DEPTH_INDEX") = index(offsetof(Splat<float>, depth));
  m.attr("PRUNED") = kPruned;
  m.attr("NEAR_DEPTH") = kNearDepth;
  m.attr("COLOUR_STRIDE") = kColourStride;
  m.attr("CELL_SUBPIXELS") = kCellPeriod * kRowPeriod;
  m.attr("COMPENSATION_FIELDS") = kCompensationFields;
  m.attr("CAMERA_OPTICS") = int(kCameraOptics);
  m.attr("RIG_OPTICS") = int(kRigOptics);
}

Lens make_lens(int64_t width_px, int64_t height_px, int64_t views, uint64_t phase0, uint64_t phase_x, uint64_t phase_y,
               double line_number, double slant_tan, double phase, bool bgr, bool continuous, double offset_start,
               double offset_step, const std::vector<uint64_t>& cell_phases, const std::vector<int>& cell_channels) {
  Lens lens{width_px, height_px, views,      phase0,       phase_x,     phase_y, line_number, slant_tan,
            phase,    bgr,       continuous, offset_start, offset_step, false,   {}};
  lens.set_cells(cell_phases, cell_channels);
  return lens;
}

void bind_lens(py::module_ m) {
  py::class_<Lens>(m, "Lens")
      .def(py::init(&make_lens), py::kw_only(), py::arg("width_px"), py::arg("height_px"), py::arg("views"),
           py::arg("phase0"), py::arg("phase_x"), py::arg("phase_y"), py::arg("line_number"), py::arg("slant_tan"),
           py::arg("phase"), py::arg("bgr"), py::arg("continuous"), py::arg("offset_start"), py::arg("offset_step"),
           py::arg("cell_phases") = std::vector<uint64_t>(), py::arg("cell_channels") = std::vector<int>())
      .def("reach", &Lens::reach)
      .def("subpixel_index", &Lens::subpixel_index, py::arg("row"), py::arg("column"), py::arg("channel"))
      .def("stands_in_order", &Lens::stands_in_order)
      .def("has_one_order", &Lens::has_one_order)
      .def(
          "view_at",
          [](const Lens& lens, int64_t row, int64_t subpixel) {
            return integer_view(lens.true_phase(row, subpixel), uint64_t(lens.views));
          },
          py::arg("row"), py::arg("subpixel"));
}

Camera<double> make_rig(const std::vector<double>& world_to_camera, const std::vector<double>& intrinsics,
                        const std::vector<double>& limits, double zero_depth, const Lens& lens, bool antialiased,
                        double aperture) {
  require(world_to_camera.size() == 16 && intrinsics.size() == 4 && limits.size() == 5, "a rig is 16 + 4 + 5 numbers");
  Camera<double> rig = make_camera<double>(world_to_camera.data(), intrinsics.data(), limits.data());
  rig.sweep = lens.reach();
  rig.inverse_zero_depth = 1 / zero_depth;
  rig.antialiased = antialiased;
  rig.aperture = aperture;
  return rig;
}

Quality make_quality(double opacity_cut, double transmittance_stop, double lattice, double contribution,
                     double evaluation) {
  return {opacity_cut * 255 > 1 ? std::log2(opacity_cut) : kLog2MinAlpha,
          std::max(transmittance_stop, kMinTransmittance), lattice, contribution, evaluation};
}

void bind_rig_and_quality(py::module_ m) {
  py::class_<Camera<double>>(m, "Rig").def(py::init(&make_rig), py::kw_only(), py::arg("world_to_camera"),
                                           py::arg("intrinsics"), py::arg("limits"), py::arg("zero_depth"),
                                           py::arg("lens"), py::arg("antialiased") = false, py::arg("aperture") = 0.0);
  py::class_<Quality>(m, "Quality")
      .def(py::init(&make_quality), py::kw_only(), py::arg("opacity_cut"), py::arg("transmittance_stop"),
           py::arg("lattice"), py::arg("contribution"), py::arg("evaluation"));
}

void bind_bins_and_counters(py::module_ m) {
  py::class_<Bins>(m, "Bins").def(
      py::init([](Address offsets, Address splats) { return Bins{at<int64_t>(offsets), at<int32_t>(splats)}; }),
      py::arg("band_offsets"), py::arg("band_splats"));
  py::class_<Counters>(m, "Counters")
      .def_readonly("intersections", &Counters::intersections)
      .def_readonly("evaluations", &Counters::evaluations)
      .def_readonly("scratch_bytes", &Counters::scratch_bytes)
      .def_readonly("tiles", &Counters::tiles)
      .def_readonly("empty_tiles", &Counters::empty_tiles)
      .def_readonly("stopped_samples", &Counters::stopped_samples)
      .def_readonly("lattice_tiles", &Counters::lattice_tiles)
      .def_readonly("lattices", &Counters::lattices)
      .def_readonly("split_lattices", &Counters::split_lattices)
      .def_readonly("refused_lattices", &Counters::refused_lattices);
}

// The structs that name the buffers of one precision.
template <class T>
void bind_buffers(py::module_ m) {
  py::class_<Gaussians<T>>(m, "Gaussians")
      .def(py::init([](int64_t count, int sh_degree, Address means, Address quaternions, Address scales,
                       Address opacities, Address sh) {
             require(sh_degree >= 0 && sh_degree <= 3, "sh_degree must be 0..3");
             return Gaussians<T>{count,         sh_degree,        at<T>(means), at<T>(quaternions),
                                 at<T>(scales), at<T>(opacities), at<T>(sh)};
           }),
           py::arg("count"), py::arg("sh_degree"), py::arg("means"), py::arg("quaternions"), py::arg("scales"),
           py::arg("opacities"), py::arg("sh"));
  py::class_<Cameras<T>>(m, "Cameras")
      .def(py::init([](int64_t scenes, int64_t per_scene, int64_t width_px, int64_t height_px, Address world_to_camera,
                       Address intrinsics, Address limits, bool antialiased, double aperture, double zero_depth,
                       int model) {
             require(model >= 0 && model < kCameraModels * kShutters, "model must be 0..11");
             return Cameras<T>{scenes,
                               per_scene,
                               width_px,
                               height_px,
                               at<T>(world_to_camera),
                               at<T>(intrinsics),
                               at<T>(limits),
                               CameraModel(model % kCameraModels),
                               antialiased,
                               aperture,
                               1 / zero_depth,
                               Shutter(model / kCameraModels)};
           }),
           py::arg("scenes"), py::arg("per_scene"), py::arg("width_px"), py::arg("height_px"),
           py::arg("world_to_camera"), py::arg("intrinsics"), py::arg("limits"), py::arg("antialiased") = false,
           py::arg("aperture") = 0.0, py::arg("zero_depth") = HUGE_VAL, py::arg("model") = 0);
  py::class_<Splats<T>>(m, "Splats")
      .def(py::init([](int64_t images, int64_t count, int colour_order, Address splats, Address colours, Address orders,
                       Address compensations) {
             return Splats<T>{images,
                              count,
                              colour_order,
                              at<Splat<T>>(splats),
                              at<T>(colours),
                              at<int32_t>(orders),
                              at<Compensation<T>>(compensations)};
           }),
           py::arg("images"), py::arg("count"), py::arg("colour_order"), py::arg("splats"), py::arg("colours"),
           py::arg("orders"), py::arg("compensations") = 0);
  py::class_<Images<T>>(m, "Images")
      .def(py::init([](Address image, Address alpha, Address depth) {
             return Images<T>{at<T>(image), at<T>(alpha), at<T>(depth)};
           }),
           py::arg("image"), py::arg("alpha"), py::arg("depth"));
}

}  // namespace

void bind_types(py::module_ root) {
  bind_constants(root);
  bind_lens(root);
  bind_rig_and_quality(root);
  bind_bins_and_counters(root);
  bind_buffers<float>(root.attr("float32"));
  bind_buffers<double>(root.attr("float64"));
}

}  // namespace lfgs
