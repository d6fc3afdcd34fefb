// Bind the stages of the method `sorted`, whose sub-pixels are sorted by view, on CPU and CUDA.
#include "bind/bindings.h"
#include "stages/stages.h"
#ifdef LFGS_WITH_CUDA
#include "cuda/sorted/sorted.h"
#endif

namespace py = pybind11;

namespace lfgs {
namespace {

void bind_plan(py::module_ root) {
  root.def(
      "plan_sorted_count",
      [](const ViewMap& map, const SubpixelTile& tile, Address places, int64_t views, Address counts, int threads) {
        plan_sorted_count(map, tile, at<int32_t>(places), views, at<int32_t>(counts), threads);
      },
      NoGil(), py::arg("map"), py::arg("tile"), py::arg("places"), py::arg("views"), py::arg("counts"),
      py::arg("threads"));
  root.def(
      "plan_sorted_fill",
      [](const ViewMap& map, const SubpixelTile& tile, Address places, int64_t views, Address starts, Address codes,
         int threads) {
        plan_sorted_fill(map, tile, at<int32_t>(places), views, at<int64_t>(starts), at<uint16_t>(codes), threads);
      },
      NoGil(), py::arg("map"), py::arg("tile"), py::arg("places"), py::arg("views"), py::arg("starts"),
      py::arg("codes"), py::arg("threads"));
}

template <class T>
void bind_composite(py::module_ m) {
  m.def(
      "composite_sorted",
      [](const Splats<T>& splats, const Bins& bins, const Cameras<T>& cameras, const SubpixelLists& lists,
         Address background, Address out, Address out8, int threads) {
        return composite_sorted<T>(splats, bins, cameras, lists, at<T>(background), at<T>(out), at<uint8_t>(out8),
                                   threads);
      },
      NoGil(), py::arg("splats"), py::arg("bins"), py::arg("cameras"), py::arg("lists"), py::arg("background"),
      py::arg("out"), py::arg("out8"), py::arg("threads"));
}

}  // namespace

void bind_sorted_types(py::module_ root) {
  root.attr("SUBPIXEL_BLOCK") = kSubpixelBlock;
  py::class_<SubpixelTile>(root, "SubpixelTile")
      .def(py::init([](int width_px, int row_bits) { return SubpixelTile{width_px, row_bits}; }), py::arg("width_px"),
           py::arg("row_bits"))
      .def_readonly("width_px", &SubpixelTile::width_px)
      .def_property_readonly("height_px", &SubpixelTile::height_px)
      .def("count", &SubpixelTile::count, py::arg("image_width_px"), py::arg("image_height_px"));
  py::class_<ViewMap>(root, "ViewMap")
      .def(py::init([](const Lens& lens) { return ViewMap{lens.width_px, lens.height_px, lens.views, nullptr, lens}; }),
           py::arg("lens"))
      .def(py::init([](int64_t width_px, int64_t height_px, int64_t views, Address table) {
             return ViewMap{width_px, height_px, views, at<int32_t>(table), Lens{}};
           }),
           py::arg("width_px"), py::arg("height_px"), py::arg("views"), py::arg("table"));
  py::class_<SubpixelLists>(root, "SubpixelLists")
      .def(py::init([](const SubpixelTile& tile, Address starts, Address codes) {
             return SubpixelLists{tile, at<int64_t>(starts), at<uint16_t>(codes)};
           }),
           py::arg("tile"), py::arg("starts"), py::arg("codes"));
}

void bind_sorted(py::module_ root) {
  bind_plan(root);
  bind_composite<float>(root.attr("float32"));
  bind_composite<double>(root.attr("float64"));
}

#ifdef LFGS_WITH_CUDA
void bind_sorted_cuda(py::module_ m) {
  using cuda::SortedChunk;
  m.attr("SORTED_STATE_BYTES") = sizeof(cuda::SortedState);
  py::class_<SortedChunk>(m, "SortedChunk")
      .def(py::init<int64_t, int64_t, int64_t, int64_t, const SubpixelTile&>(), py::kw_only(), py::arg("views"),
           py::arg("gaussians"), py::arg("width_px"), py::arg("height_px"), py::arg("tile"))
      .def("bytes", [](SortedChunk chunk) { return chunk.place(nullptr); })
      .def(
          "place", [](SortedChunk& chunk, Address work) { return chunk.place(at<void>(work)); }, py::arg("work"))
      .def("place_ids", [](SortedChunk& chunk, Address ids) { chunk.ids = at<uint32_t>(ids); }, py::arg("ids"));
  m.def(
      "project_sorted",
      [](const SortedChunk& chunk, const Gaussians<float>& gaussians, const Cameras<float>& cameras, Address stream) {
        cuda::project_sorted(chunk, read_only(gaussians), cameras, at<void>(stream));
      },
      NoGil(), py::arg("chunk"), py::arg("gaussians"), py::arg("cameras"), py::arg("stream"));
  m.def(
      "count_sorted", [](const SortedChunk& chunk, Address stream) { cuda::count_sorted(chunk, at<void>(stream)); },
      NoGil(), py::arg("chunk"), py::arg("stream"));
  m.def(
      "fill_sorted", [](const SortedChunk& chunk, Address stream) { cuda::fill_sorted(chunk, at<void>(stream)); },
      NoGil(), py::arg("chunk"), py::arg("stream"));
  m.def(
      "order_sorted", [](const SortedChunk& chunk, Address stream) { cuda::order_sorted(chunk, at<void>(stream)); },
      NoGil(), py::arg("chunk"), py::arg("stream"));
  m.def(
      "composite_sorted",
      [](const SortedChunk& chunk, const SubpixelLists& lists, Address background, Address out, Address out8,
         Address stream) {
        cuda::composite_sorted(chunk, lists, at<float>(background), at<float>(out), at<uint8_t>(out8),
                               at<void>(stream));
      },
      NoGil(), py::arg("chunk"), py::arg("lists"), py::arg("background"), py::arg("out"), py::arg("out8"),
      py::arg("stream"));
}
#endif

}  // namespace lfgs
