// Bind the features of Gaussians in ordinary images, and the median depth: on the CPU in both precisions, and on CUDA.
#include <pybind11/pybind11.h>

#include "base/error.h"
#include "bind/bindings.h"
#include "stages/stages.h"
#ifdef LFGS_WITH_CUDA
#include "cuda/stages/stages.h"
#endif

namespace py = pybind11;

namespace lfgs {
namespace {

template <class T>
void bind_type(py::module_ m) {
  py::class_<Features<T>>(m, "Features")
      .def(
          py::init([](int64_t channels, int64_t images_per_row, Address values, Address image, Address image_gradient) {
            require(channels >= 0 && images_per_row >= 1, "features need channels >= 0 and images per row >= 1");
            return Features<T>{channels, images_per_row, at<T>(values), at<T>(image), at<T>(image_gradient)};
          }),
          py::arg("channels"), py::arg("images_per_row"), py::arg("values"), py::arg("image") = 0,
          py::arg("image_gradient") = 0);
}

template <class T>
void bind_stages(py::module_ m) {
  m.def(
      "composite_features",
      [](const Splats<T>& splats, const Bins& bins, int64_t width_px, int64_t height_px, const Features<T>& features,
         Address out, int threads) {
        return composite_features<T>(splats, bins, width_px, height_px, features, at<T>(out), threads);
      },
      NoGil(), py::arg("splats"), py::arg("bins"), py::arg("width_px"), py::arg("height_px"), py::arg("features"),
      py::arg("out"), py::arg("threads"));
  m.def(
      "composite_median_depth",
      [](const Splats<T>& splats, const Bins& bins, int64_t width_px, int64_t height_px, Address out, int threads) {
        return composite_median_depth<T>(splats, bins, width_px, height_px, at<T>(out), threads);
      },
      NoGil(), py::arg("splats"), py::arg("bins"), py::arg("width_px"), py::arg("height_px"), py::arg("out"),
      py::arg("threads"));
  m.def(
      "composite_features_backward",
      [](const Splats<T>& splats, const Bins& bins, int64_t width_px, int64_t height_px, const Features<T>& features,
         int64_t intersections, Address first_intersection, Address intersection_gradients, Address sums,
         Address g_features, int threads) {
        return composite_features_backward<T>(splats, bins, width_px, height_px, features, intersections,
                                              at<int64_t>(first_intersection), at<T>(intersection_gradients),
                                              at<T>(sums), at<T>(g_features), threads);
      },
      NoGil(), py::arg("splats"), py::arg("bins"), py::arg("width_px"), py::arg("height_px"), py::arg("features"),
      py::arg("intersections"), py::arg("first_intersection"), py::arg("intersection_gradients"), py::arg("sums"),
      py::arg("g_features"), py::arg("threads"));
  m.def(
      "sum_intersections",
      [](const Splats<T>& splats, int64_t height_px, Address first_intersection, Address intersection_gradients,
         bool absolute, Address sums, int threads) {
        sum_intersections<T>(splats, height_px, at<int64_t>(first_intersection), at<T>(intersection_gradients),
                             absolute, at<T>(sums), threads);
      },
      NoGil(), py::arg("splats"), py::arg("height_px"), py::arg("first_intersection"),
      py::arg("intersection_gradients"), py::arg("absolute"), py::arg("sums"), py::arg("threads"));
}

}  // namespace

void bind_features(py::module_ root) {
  root.attr("COLOUR_SUM") = int(kColourSum);
  root.attr("FEATURE_GRADIENT") = kSplatFields + kFeatureChunk;
  bind_type<float>(root.attr("float32"));
  bind_type<double>(root.attr("float64"));
  bind_stages<float>(root.attr("float32"));
  bind_stages<double>(root.attr("float64"));
}

#ifdef LFGS_WITH_CUDA
void bind_features_cuda(py::module_ cuda) {
  cuda.attr("FEATURE_SUMS") = cuda::kFeatureSums;
  cuda.def(
      "composite_features",
      [](const Splats<float>& splats, const cuda::Image& image, Address ranges,
         const cuda::Intersections& intersections, const Features<float>& features, Address out, Address stream) {
        cuda::composite_features(splats, image, at<int64_t>(ranges), intersections, features, at<float>(out),
                                 at<void>(stream));
      },
      NoGil(), py::arg("splats"), py::arg("image"), py::arg("ranges"), py::arg("intersections"), py::arg("features"),
      py::arg("out"), py::arg("stream"));
  cuda.def(
      "composite_median_depth",
      [](const Splats<float>& splats, const cuda::Image& image, Address ranges,
         const cuda::Intersections& intersections, Address out, Address stream) {
        cuda::composite_median_depth(splats, image, at<int64_t>(ranges), intersections, at<float>(out),
                                     at<void>(stream));
      },
      NoGil(), py::arg("splats"), py::arg("image"), py::arg("ranges"), py::arg("intersections"), py::arg("out"),
      py::arg("stream"));
  cuda.def(
      "composite_features_backward",
      [](const Splats<float>& splats, const cuda::Image& image, Address ranges,
         const cuda::Intersections& intersections, Address intersection_ranges, const Features<float>& features,
         Address intersection_gradients, Address sums, Address g_features, Address stream) {
        cuda::composite_features_backward(
            splats, image, at<int64_t>(ranges), intersections, at<cuda::IntersectionRange>(intersection_ranges),
            features, at<float>(intersection_gradients), at<float>(sums), at<float>(g_features), at<void>(stream));
      },
      NoGil(), py::arg("splats"), py::arg("image"), py::arg("ranges"), py::arg("intersections"),
      py::arg("intersection_ranges"), py::arg("features"), py::arg("intersection_gradients"), py::arg("sums"),
      py::arg("g_features"), py::arg("stream"));
}
#endif

}  // namespace lfgs
