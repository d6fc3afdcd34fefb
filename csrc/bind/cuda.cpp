// Bind the stages of a CUDA device and the kernels of the network. Streams and all pointers are integers, as on the
// CPU.
#include <pybind11/pybind11.h>
#include <pybind11/stl.h>

#include "bind/bindings.h"
#include "cuda/stages/stages.h"
#include "network/group_norm.h"
#include "cuda/png/png.h"

namespace py = pybind11;

namespace lfgs {
namespace {

using G = Gaussians<float>;

void bind_image_and_intersections(py::module_ m) {
  m.attr("architectures") = cuda::architectures();
  m.attr("IMAGE_SUMS") = cuda::kImageSums;
  m.attr("ABSOLUTE_IMAGE_SUMS") = cuda::kAbsoluteImageSums;
  m.attr("SPLAT_SUMS") = int(kSplatSums);
  m.attr("DIRECT_SUMS") = cuda::kDirectSums;
  m.attr("LENS_SUMS") = cuda::kLensSums;
  py::class_<cuda::Image>(m, "Image")
      .def(py::init([](int64_t count, int64_t width_px, int64_t height_px, bool lens) {
             return cuda::Image{count, width_px, height_px, lens ? cuda::kDirectTile : cuda::kImageTile};
           }),
           py::arg("count"), py::arg("width_px"), py::arg("height_px"), py::arg("lens"))
      .def("tiles", [](const cuda::Image& i) { return i.count * cuda::tile_count(i.tile, i.width_px, i.height_px); });
  py::class_<cuda::Intersections>(m, "Intersections")
      .def(py::init([](int64_t count, Address tiles, Address sorted_tiles, Address indices, Address sorted_indices,
                       Address splats, Address sorted_splats, Address total) {
             return cuda::Intersections{count,
                                        at<uint32_t>(tiles),
                                        at<uint32_t>(sorted_tiles),
                                        at<uint32_t>(indices),
                                        at<uint32_t>(sorted_indices),
                                        at<uint32_t>(splats),
                                        at<uint32_t>(sorted_splats),
                                        at<int64_t>(total)};
           }),
           py::arg("count"), py::arg("tiles"), py::arg("sorted_tiles"), py::arg("indices"), py::arg("sorted_indices"),
           py::arg("splats"), py::arg("sorted_splats"), py::arg("total") = 0);
}

void bind_project(py::module_ m) {
  m.def(
      "project_images",
      [](const G& gaussians, const Cameras<float>& cameras, const Splats<float>& out, Address keys, Address stream) {
        cuda::project_images(read_only(gaussians), cameras, out, at<uint64_t>(keys), at<void>(stream));
      },
      NoGil(), py::arg("gaussians"), py::arg("cameras"), py::arg("out"), py::arg("keys"), py::arg("stream"));
  m.def(
      "project_direct",
      [](const G& gaussians, const Camera<double>& rig, const Lens& lens, double tolerance, const Splats<float>& out,
         Address keys, Address error, Address stream) {
        cuda::project_direct(read_only(gaussians), rig, lens, tolerance, out, at<uint64_t>(keys), at<float>(error),
                             at<void>(stream));
      },
      NoGil(), py::arg("gaussians"), py::arg("rig"), py::arg("lens"), py::arg("tolerance"), py::arg("out"),
      py::arg("keys"), py::arg("error"), py::arg("stream"));
  m.def("camera_blocks", &cuda::camera_blocks, py::arg("gaussians"));
  m.def(
      "project_images_backward",
      [](const G& gaussians, const Cameras<float>& cameras, Address sums, const G& out, Address screen, bool absolute,
         Address camera_partials, bool optics, Address stream) {
        cuda::project_images_backward(read_only(gaussians), cameras, at<float>(sums), out, at<float>(screen), absolute,
                                      at<float>(camera_partials), optics, at<void>(stream));
      },
      NoGil(), py::arg("gaussians"), py::arg("cameras"), py::arg("sums"), py::arg("out"), py::arg("screen"),
      py::arg("absolute"), py::arg("camera_partials"), py::arg("optics"), py::arg("stream"));
  m.def(
      "sum_intersections",
      [](int64_t splats, Address intersection_ranges, bool absolute, Address intersection_gradients, Address sums,
         Address stream) {
        cuda::sum_intersections(splats, at<cuda::IntersectionRange>(intersection_ranges), absolute,
                                at<float>(intersection_gradients), at<float>(sums), at<void>(stream));
      },
      NoGil(), py::arg("splats"), py::arg("intersection_ranges"), py::arg("absolute"),
      py::arg("intersection_gradients"), py::arg("sums"), py::arg("stream"));
  m.def("rig_blocks", &cuda::rig_blocks, py::arg("gaussians"));
  m.def(
      "project_direct_backward",
      [](const G& gaussians, const Camera<double>& rig, const Splats<float>& splats, Address intersection_ranges,
         Address intersection_gradients, const G& out, Address rig_partials, Address stream) {
        cuda::project_direct_backward(
            read_only(gaussians), rig, splats, at<cuda::IntersectionRange>(intersection_ranges),
            at<float>(intersection_gradients), out, at<double>(rig_partials), at<void>(stream));
      },
      NoGil(), py::arg("gaussians"), py::arg("rig"), py::arg("splats"), py::arg("intersection_ranges"),
      py::arg("intersection_gradients"), py::arg("out"), py::arg("rig_partials"), py::arg("stream"));
}

void bind_order_and_bin(py::module_ m) {
  m.def("order_bytes", &cuda::order_bytes, py::arg("items"));
  m.def(
      "order",
      [](int64_t items, int64_t images, Address keys, Address sorted_keys, Address indices, Address temporary,
         size_t temporary_bytes, Address stream) {
        cuda::order(items, images, at<uint64_t>(keys), at<uint64_t>(sorted_keys), at<uint32_t>(indices),
                    at<void>(temporary), temporary_bytes, at<void>(stream));
      },
      NoGil(), py::arg("items"), py::arg("images"), py::arg("keys"), py::arg("sorted_keys"), py::arg("indices"),
      py::arg("temporary"), py::arg("temporary_bytes"), py::arg("stream"));
  m.def("count_bytes", &cuda::count_bytes, py::arg("items"));
  m.def(
      "bin_count",
      [](const Splats<float>& splats, const cuda::Image& image, Address counts, Address intersections,
         Address temporary, size_t temporary_bytes, Address stream) {
        cuda::bin_count(splats, image, at<uint32_t>(counts), at<int64_t>(intersections), at<void>(temporary),
                        temporary_bytes, at<void>(stream));
      },
      NoGil(), py::arg("splats"), py::arg("image"), py::arg("counts"), py::arg("intersections"), py::arg("temporary"),
      py::arg("temporary_bytes"), py::arg("stream"));
  m.def("fill_bytes", &cuda::fill_bytes, py::arg("items"), py::arg("intersections"));
  m.def(
      "bin_fill",
      [](const Splats<float>& splats, const cuda::Image& image, Address indices, Address counts, Address ends,
         const cuda::Intersections& intersections, Address ranges, Address intersection_ranges, Address temporary,
         size_t temporary_bytes, Address stream) {
        cuda::bin_fill(splats, image, at<uint32_t>(indices), at<uint32_t>(counts), at<int64_t>(ends), intersections,
                       at<int64_t>(ranges), at<cuda::IntersectionRange>(intersection_ranges), at<void>(temporary),
                       temporary_bytes, at<void>(stream));
      },
      NoGil(), py::arg("splats"), py::arg("image"), py::arg("indices"), py::arg("counts"), py::arg("ends"),
      py::arg("intersections"), py::arg("ranges"), py::arg("intersection_ranges"), py::arg("temporary"),
      py::arg("temporary_bytes"), py::arg("stream"));
}

void bind_composite(py::module_ m) {
  m.def(
      "composite_images",
      [](const Splats<float>& splats, const cuda::Image& image, Address ranges,
         const cuda::Intersections& intersections, Address background, const Images<float>& out, Address stream) {
        cuda::composite_images(splats, image, at<int64_t>(ranges), intersections, at<float>(background), out,
                               at<void>(stream));
      },
      NoGil(), py::arg("splats"), py::arg("image"), py::arg("ranges"), py::arg("intersections"), py::arg("background"),
      py::arg("out"), py::arg("stream"));
  m.def(
      "composite_images_backward",
      [](const Splats<float>& splats, const cuda::Image& image, Address ranges,
         const cuda::Intersections& intersections, const Images<float>& images, const Images<float>& gradients,
         bool absolute, Address intersection_gradients, Address tile_background, Address stream) {
        cuda::composite_images_backward(splats, image, at<int64_t>(ranges), intersections, read_only(images),
                                        read_only(gradients), absolute, at<float>(intersection_gradients),
                                        at<float>(tile_background), at<void>(stream));
      },
      NoGil(), py::arg("splats"), py::arg("image"), py::arg("ranges"), py::arg("intersections"), py::arg("images"),
      py::arg("gradients"), py::arg("absolute"), py::arg("intersection_gradients"), py::arg("tile_background"),
      py::arg("stream"));
  m.def(
      "composite_direct",
      [](const Splats<float>& splats, const cuda::Image& image, Address ranges,
         const cuda::Intersections& intersections, const Lens& lens, Address background, Address out, Address stream) {
        cuda::composite_direct(splats, image, at<int64_t>(ranges), intersections, lens, at<float>(background),
                               at<float>(out), at<void>(stream));
      },
      NoGil(), py::arg("splats"), py::arg("image"), py::arg("ranges"), py::arg("intersections"), py::arg("lens"),
      py::arg("background"), py::arg("out"), py::arg("stream"));
  m.def(
      "composite_direct_backward",
      [](const Splats<float>& splats, const cuda::Image& image, Address ranges,
         const cuda::Intersections& intersections, const Lens& lens, Address pixels, Address gradient,
         Address intersection_gradients, Address tile_background, Address tile_lens, Address stream) {
        cuda::composite_direct_backward(splats, image, at<int64_t>(ranges), intersections, lens, at<float>(pixels),
                                        at<float>(gradient), at<float>(intersection_gradients),
                                        at<float>(tile_background), at<float>(tile_lens), at<void>(stream));
      },
      NoGil(), py::arg("splats"), py::arg("image"), py::arg("ranges"), py::arg("intersections"), py::arg("lens"),
      py::arg("pixels"), py::arg("gradient"), py::arg("intersection_gradients"), py::arg("tile_background"),
      py::arg("tile_lens"), py::arg("stream"));
}

// Kernels of the network (csrc/network).
void bind_network(py::module_ m) {
  m.def(
      "group_norm_silu",
      [](int64_t images, int64_t pixels, int channels, int groups, Address in, Address weight, Address bias, float eps,
         Address out, Address stream) {
        cuda::group_norm_silu({images, pixels, channels, groups}, at<uint32_t>(in), at<uint32_t>(weight),
                              at<uint32_t>(bias), eps, at<uint32_t>(out), at<void>(stream));
      },
      NoGil(), py::arg("images"), py::arg("pixels"), py::arg("channels"), py::arg("groups"), py::arg("maps"),
      py::arg("weight"), py::arg("bias"), py::arg("eps"), py::arg("out"), py::arg("stream"));
}

}  // namespace

void bind_cuda(py::module_ cuda) {
  bind_image_and_intersections(cuda);
  bind_project(cuda);
  bind_order_and_bin(cuda);
  bind_composite(cuda);
  bind_network(cuda);
}

// PNG: how images are deflated.
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
