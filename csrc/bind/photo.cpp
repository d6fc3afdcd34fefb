// Bind the stages that lay a photo over the network's prediction.
#include "stages/photo.h"

#include "bind/bindings.h"
#ifdef LFGS_WITH_CUDA
#include "cuda/photo/photo.h"
#endif

namespace py = pybind11;

namespace lfgs {

void bind_photo(py::module_ root) {
  py::class_<SheetLook>(root, "SheetLook")
      .def(py::init([](float deviation, float thickness, float blur, float opacity, float most_opaque,
                       float most_of_sheet, float sharper_colour, float sharper_outline, float haze, float object,
                       float same_surface, float steepest) {
             return SheetLook{deviation,      thickness,       blur, opacity, most_opaque,  most_of_sheet,
                              sharper_colour, sharper_outline, haze, object,  same_surface, steepest};
           }),
           py::kw_only(), py::arg("deviation"), py::arg("thickness"), py::arg("blur"), py::arg("opacity"),
           py::arg("most_opaque"), py::arg("most_of_sheet"), py::arg("sharper_colour"), py::arg("sharper_outline"),
           py::arg("haze"), py::arg("object"), py::arg("same_surface"), py::arg("steepest"));
  py::class_<RampWindow>(root, "RampWindow")
      .def(py::init([](int radius, int step, float deviation, float least) {
             return RampWindow{radius, step, deviation, least};
           }),
           py::kw_only(), py::arg("radius"), py::arg("step"), py::arg("deviation"), py::arg("least"));
  py::class_<RampLook>(root, "RampLook")
      .def(py::init([](float steep, float slope, float down, float apart, float similar, float there, int reach,
                       int around, int spread, const RampWindow& snap, const RampWindow& clean, int snaps, int cleans) {
             return RampLook{steep,  slope,  down, apart, similar, there, reach,
                             around, spread, snap, clean, snaps,   cleans};
           }),
           py::kw_only(), py::arg("steep"), py::arg("slope"), py::arg("down"), py::arg("apart"), py::arg("similar"),
           py::arg("there"), py::arg("reach"), py::arg("around"), py::arg("spread"), py::arg("snap"), py::arg("clean"),
           py::arg("snaps"), py::arg("cleans"));
  py::class_<Sheet>(root, "Sheet")
      .def(py::init([](int64_t height, int64_t width, int factor, Address disparity, Address harmonics, Address mask,
                       Address photo, Address intrinsics, const SheetLook& look, const RampLook& ramps, Address soft,
                       Address surface, Address other, Address marks, const Gaussians<float>& out) {
             return Sheet{height,
                          width,
                          factor,
                          at<float>(disparity),
                          at<float>(harmonics),
                          at<float>(mask),
                          at<float>(photo),
                          at<float>(intrinsics),
                          look,
                          ramps,
                          at<float>(soft),
                          at<float>(surface),
                          at<float>(other),
                          at<uint8_t>(marks),
                          out};
           }),
           py::kw_only(), py::arg("height"), py::arg("width"), py::arg("factor"), py::arg("disparity"),
           py::arg("harmonics"), py::arg("mask"), py::arg("photo"), py::arg("intrinsics"), py::arg("look"),
           py::arg("ramps"), py::arg("soft"), py::arg("surface"), py::arg("other"), py::arg("marks"), py::arg("out"));
  py::class_<SurfaceLook>(root, "SurfaceLook")
      .def(py::init([](float averaged, float softness, float solid, float most_solid, float shrunk, float back) {
             return SurfaceLook{averaged, softness, solid, most_solid, shrunk, back};
           }),
           py::kw_only(), py::arg("averaged"), py::arg("softness"), py::arg("solid"), py::arg("most_solid"),
           py::arg("shrunk"), py::arg("back"));
  py::class_<Surface>(root, "Surface")
      .def(py::init([](int64_t height, int64_t width, int layers, const Gaussians<float>& cloud, Address mask,
                       Address intrinsics, const SurfaceLook& look, Address planes, Address disparity,
                       Address harmonics) {
             return Surface{height,
                            width,
                            layers,
                            cloud,
                            at<float>(mask),
                            at<float>(intrinsics),
                            look,
                            at<float>(planes),
                            at<float>(disparity),
                            at<float>(harmonics)};
           }),
           py::kw_only(), py::arg("height"), py::arg("width"), py::arg("layers"), py::arg("cloud"), py::arg("mask"),
           py::arg("intrinsics"), py::arg("look"), py::arg("planes"), py::arg("disparity"), py::arg("harmonics"));
  root.def(
      "surface", [](const Surface& job, int threads) { surface(job, threads); }, NoGil(), py::arg("job"),
      py::arg("threads"));
  root.def(
      "sheet", [](const Sheet& job, int threads) { sheet(job, threads); }, NoGil(), py::arg("job"), py::arg("threads"));
}

#ifdef LFGS_WITH_CUDA
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
#endif

}  // namespace lfgs
