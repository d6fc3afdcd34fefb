// Bind the CPU's stages in both precisions, and the choice of the vector instructions that they use.
#include <pybind11/pybind11.h>
#include <pybind11/stl.h>

#include <string>
#include <vector>

#include "base/error.h"
#include "bind/bindings.h"
#include "hwy/highway.h"
#include "hwy/targets.h"
#include "stages/stages.h"

namespace py = pybind11;

namespace lfgs {
namespace {

template <class T>
void bind_project(py::module_ m) {
  using G = Gaussians<T>;
  m.def(
      "project_images",
      [](const G& gaussians, const Cameras<T>& cameras, const Splats<T>& out, int threads) {
        project_images<T>(read_only(gaussians), cameras, out, threads);
      },
      NoGil(), py::arg("gaussians"), py::arg("cameras"), py::arg("out"), py::arg("threads"));
  m.def(
      "project_images_backward",
      [](const G& gaussians, const Cameras<T>& cameras, const Splats<T>& splats, Address first_intersection,
         Address intersection_gradients, const G& out, Address screen, bool absolute, Address g_world_to_camera,
         Address g_optics, int threads) {
        project_images_backward<T>(read_only(gaussians), cameras, splats, at<int64_t>(first_intersection),
                                   at<T>(intersection_gradients), out, at<T>(screen), absolute,
                                   at<T>(g_world_to_camera), at<T>(g_optics), threads);
      },
      NoGil(), py::arg("gaussians"), py::arg("cameras"), py::arg("splats"), py::arg("first_intersection"),
      py::arg("intersection_gradients"), py::arg("out"), py::arg("screen"), py::arg("absolute"),
      py::arg("g_world_to_camera"), py::arg("g_optics"), py::arg("threads"));
  m.def(
      "project_direct",
      [](const G& gaussians, const Camera<double>& rig, const Lens& lens, const Quality& quality, double tolerance,
         const Splats<T>& out,
         int threads) { return project_direct<T>(read_only(gaussians), rig, lens, quality, tolerance, out, threads); },
      NoGil(), py::arg("gaussians"), py::arg("rig"), py::arg("lens"), py::arg("quality"), py::arg("tolerance"),
      py::arg("out"), py::arg("threads"));
  m.def(
      "project_direct_backward",
      [](const G& gaussians, const Camera<double>& rig, const Lens& lens, const Splats<T>& splats,
         Address first_intersection, Address intersection_gradients, const G& out, Address g_rig, int threads) {
        project_direct_backward<T>(read_only(gaussians), rig, lens, splats, at<int64_t>(first_intersection),
                                   at<T>(intersection_gradients), out, at<double>(g_rig), threads);
      },
      NoGil(), py::arg("gaussians"), py::arg("rig"), py::arg("lens"), py::arg("splats"), py::arg("first_intersection"),
      py::arg("intersection_gradients"), py::arg("out"), py::arg("g_rig"), py::arg("threads"));
}

template <class T>
void bind_order_and_bin(py::module_ m) {
  m.def(
      "order",
      [](const Splats<T>& splats, Address indices, Address drawn, int threads) {
        order<T>(splats, at<int32_t>(indices), at<int64_t>(drawn), threads);
      },
      NoGil(), py::arg("splats"), py::arg("order"), py::arg("drawn"), py::arg("threads"));
  m.def(
      "bin_count",
      [](const Splats<T>& splats, Address indices, Address drawn, int64_t height_px, const Bins& bins, int threads) {
        return bin_count<T>(splats, at<int32_t>(indices), at<int64_t>(drawn), height_px, bins, threads);
      },
      NoGil(), py::arg("splats"), py::arg("order"), py::arg("drawn"), py::arg("height_px"), py::arg("bins"),
      py::arg("threads"));
  m.def(
      "bin_fill",
      [](const Splats<T>& splats, Address indices, Address drawn, int64_t height_px, const Bins& bins, int threads) {
        bin_fill<T>(splats, at<int32_t>(indices), at<int64_t>(drawn), height_px, bins, threads);
      },
      NoGil(), py::arg("splats"), py::arg("order"), py::arg("drawn"), py::arg("height_px"), py::arg("bins"),
      py::arg("threads"));
  m.def(
      "first_intersections",
      [](const Splats<T>& splats, int64_t height_px, const Bins& bins, Address first_intersection, int threads) {
        first_intersections<T>(splats, height_px, bins, at<int64_t>(first_intersection), threads);
      },
      NoGil(), py::arg("splats"), py::arg("height_px"), py::arg("bins"), py::arg("first_intersection"),
      py::arg("threads"));
}

template <class T>
void bind_composite_images(py::module_ m) {
  m.def(
      "composite_images",
      [](const Splats<T>& splats, const Bins& bins, const Cameras<T>& cameras, Address background, const Images<T>& out,
         int threads) { return composite_images<T>(splats, bins, cameras, at<T>(background), out, threads); },
      NoGil(), py::arg("splats"), py::arg("bins"), py::arg("cameras"), py::arg("background"), py::arg("out"),
      py::arg("threads"));
  m.def(
      "composite_images_backward",
      [](const Splats<T>& splats, const Bins& bins, const Cameras<T>& cameras, Address background,
         const Images<T>& images, const Images<T>& gradients, bool absolute, Address first_intersection,
         Address intersection_gradients, Address band_background, int threads) {
        return composite_images_backward<T>(splats, bins, cameras, at<T>(background), read_only(images),
                                            read_only(gradients), absolute, at<int64_t>(first_intersection),
                                            at<T>(intersection_gradients), at<T>(band_background), threads);
      },
      NoGil(), py::arg("splats"), py::arg("bins"), py::arg("cameras"), py::arg("background"), py::arg("images"),
      py::arg("gradients"), py::arg("absolute"), py::arg("first_intersection"), py::arg("intersection_gradients"),
      py::arg("band_background"), py::arg("threads"));
}

template <class T>
void bind_composite_direct(py::module_ m) {
  m.def(
      "composite_direct",
      [](const Splats<T>& splats, const Bins& bins, const Lens& lens, const Quality& quality, Address background,
         Address out, Address out8, int threads) {
        return composite_direct<T>(splats, bins, lens, quality, at<T>(background), at<T>(out), at<uint8_t>(out8),
                                   threads);
      },
      NoGil(), py::arg("splats"), py::arg("bins"), py::arg("lens"), py::arg("quality"), py::arg("background"),
      py::arg("out"), py::arg("out8"), py::arg("threads"));
  m.def(
      "composite_direct_backward",
      [](const Splats<T>& splats, const Bins& bins, const Lens& lens, Address background, Address image,
         Address gradient, Address first_intersection, Address intersection_gradients, Address band_background,
         Address g_offsets, int threads) {
        return composite_direct_backward<T>(splats, bins, lens, at<T>(background), at<T>(image), at<T>(gradient),
                                            at<int64_t>(first_intersection), at<T>(intersection_gradients),
                                            at<T>(band_background), at<T>(g_offsets), threads);
      },
      NoGil(), py::arg("splats"), py::arg("bins"), py::arg("lens"), py::arg("background"), py::arg("image"),
      py::arg("gradient"), py::arg("first_intersection"), py::arg("intersection_gradients"), py::arg("band_background"),
      py::arg("g_offsets"), py::arg("threads"));
}

template <class T>
void bind_stages(py::module_ m) {
  bind_project<T>(m);
  bind_order_and_bin<T>(m);
  bind_composite_images<T>(m);
  bind_composite_direct<T>(m);
}

// The instruction sets that were compiled and that this processor has. The static one and scalar code, if compiled
// (LFGS_SANITIZE), always run.
int64_t usable_targets() { return (hwy::SupportedTargets() | HWY_STATIC_TARGET | HWY_EMU128) & HWY_TARGETS; }

std::vector<std::string> simd_targets() {
  std::vector<std::string> names;
  for (int64_t left = usable_targets(); left; left &= left - 1) names.push_back(hwy::TargetName(left & -left));
  return names;
}

// Restrict run-time dispatch to one vector instruction set ("" for the best there is).
void set_simd_target(const std::string& name) {
  hwy::SetSupportedTargetsForTest(0);
  int64_t chosen = 0;
  for (int64_t left = usable_targets(); left; left &= left - 1)
    if (hwy::TargetName(left & -left) == name) chosen = left & -left;
  require(name.empty() || chosen, "SIMD target '" + name + "' is not among simd_targets()");
  if (chosen) hwy::SetSupportedTargetsForTest(chosen);
  hwy::GetChosenTarget().Update(hwy::SupportedTargets());
}

}  // namespace

void bind_cpu(py::module_ root) {
  root.def("band_count", &band_count, py::arg("height_px"));
  root.def("image_intersection_gradient_size", &image_intersection_gradient_size, py::arg("absolute"));
  root.def("intersection_gradient_size", &intersection_gradient_size, py::arg("colour_order"),
           py::arg("compensated") = false);
  root.def("simd_targets", &simd_targets);
  root.def("set_simd_target", &set_simd_target, py::arg("name"));
  bind_stages<float>(root.attr("float32"));
  bind_stages<double>(root.attr("float64"));
}

}  // namespace lfgs
