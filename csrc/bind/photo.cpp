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
  py::class_<Sheet>(root, "Sheet")
      .def(py::init([](int64_t height, int64_t width, int factor, Address disparity, Address harmonics, Address photo,
                       Address intrinsics, const SheetLook& look, Address soft, Address surface,
                       const Gaussians<float>& out) {
             return Sheet{height,
                          width,
                          factor,
                          at<float>(disparity),
                          at<float>(harmonics),
                          at<float>(photo),
                          at<float>(intrinsics),
                          look,
                          at<float>(soft),
                          at<float>(surface),
                          out};
           }),
           py::kw_only(), py::arg("height"), py::arg("width"), py::arg("factor"), py::arg("disparity"),
           py::arg("harmonics"), py::arg("photo"), py::arg("intrinsics"), py::arg("look"), py::arg("soft"),
           py::arg("surface"), py::arg("out"));
  py::class_<SurfaceLook>(root, "SurfaceLook")
      .def(py::init([](float averaged, float softness) { return SurfaceLook{averaged, softness}; }), py::kw_only(),
           py::arg("averaged"), py::arg("softness"));
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
