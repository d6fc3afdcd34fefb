// The Python module: integers -> pointers, Error -> ValueError. It knows neither torch nor NumPy; Python owns every
// buffer and checks every argument before it hands addresses over. The GIL is released while a stage runs.
#include <pybind11/pybind11.h>
#include <pybind11/stl.h>

#include "base/error.h"
#include "bind/addresses.h"
#include "hwy/highway.h"
#include "hwy/targets.h"
#include "math/footprint.h"
#include "stages/stages.h"
#ifdef LFGS_WITH_CUDA
#include "cuda/common/architectures.h"
#include "network/group_norm.h"
#include "cuda/stages/stages.h"
#endif

namespace py = pybind11;

namespace lfgs {
namespace {

View<double> view_of(const std::vector<double>& world_to_camera, const std::vector<double>& intrinsics,
                     const std::vector<double>& limits, double zero_depth, const Lens& lens, bool antialiased) {
  require(world_to_camera.size() == 16 && intrinsics.size() == 4 && limits.size() == 5, "a rig is 16 + 4 + 5 numbers");
  View<double> rig = make_view<double>(world_to_camera.data(), intrinsics.data(), limits.data());
  rig.sweep = lens.reach();
  rig.inverse_zero_depth = 1 / zero_depth;
  rig.antialiased = antialiased;
  return rig;
}

template <class T>
void bind_stages(py::module_ m) {
  using G = Gaussians<T>;
  auto as_const = [](const G& g) {
    return Gaussians<const T>{g.count, g.sh_degree, g.means, g.quaternions, g.scales, g.opacities, g.sh};
  };
  py::class_<G>(m, "Gaussians")
      .def(py::init([](int64_t count, int sh_degree, Address means, Address quaternions, Address scales,
                       Address opacities, Address sh) {
             require(sh_degree >= 0 && sh_degree <= 3, "sh_degree must be 0..3");
             return G{count, sh_degree, at<T>(means), at<T>(quaternions), at<T>(scales), at<T>(opacities), at<T>(sh)};
           }),
           py::arg("count"), py::arg("sh_degree"), py::arg("means"), py::arg("quaternions"), py::arg("scales"),
           py::arg("opacities"), py::arg("sh"));
  py::class_<Cameras<T>>(m, "Cameras")
      .def(py::init([](int64_t scenes, int64_t per_scene, int64_t width_px, int64_t height_px, Address world_to_camera,
                       Address intrinsics, Address limits, bool antialiased) {
             return Cameras<T>{
                 scenes,        per_scene,  width_px, height_px, at<T>(world_to_camera), at<T>(intrinsics),
                 at<T>(limits), antialiased};
           }),
           py::arg("scenes"), py::arg("per_scene"), py::arg("width_px"), py::arg("height_px"),
           py::arg("world_to_camera"), py::arg("intrinsics"), py::arg("limits"), py::arg("antialiased") = false);
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
  py::class_<DenseImages<T>>(m, "DenseImages")
      .def(py::init([](Address image, Address alpha, Address depth) {
             return DenseImages<T>{at<T>(image), at<T>(alpha), at<T>(depth)};
           }),
           py::arg("image"), py::arg("alpha"), py::arg("depth"));
  auto read_only = [](const DenseImages<T>& i) { return DenseImages<const T>{i.image, i.alpha, i.depth}; };

  m.def(
      "project_dense",
      [as_const](const G& g, const Cameras<T>& cameras, const Splats<T>& out, int threads) {
        project_dense<T>(as_const(g), cameras, out, threads);
      },
      NoGil());
  m.def(
      "project_dense_backward",
      [as_const](const G& g, const Cameras<T>& cameras, const Splats<T>& splats, Address first_pair,
                 Address pair_gradients, const G& out, Address g_world_to_camera, int threads) {
        project_dense_backward<T>(as_const(g), cameras, splats, at<int64_t>(first_pair), at<T>(pair_gradients), out,
                                  at<T>(g_world_to_camera), threads);
      },
      NoGil());
  m.def(
      "project_lens",
      [as_const](const G& g, const View<double>& rig, const Lens& lens, const Quality& quality, double tolerance,
                 const Splats<T>& out,
                 int threads) { return project_lens<T>(as_const(g), rig, lens, quality, tolerance, out, threads); },
      NoGil());
  m.def(
      "project_lens_backward",
      [as_const](const G& g, const View<double>& rig, const Lens& lens, const Splats<T>& splats, Address first_pair,
                 Address pair_gradients, const G& out, int threads) {
        project_lens_backward<T>(as_const(g), rig, lens, splats, at<int64_t>(first_pair), at<T>(pair_gradients), out,
                                 threads);
      },
      NoGil());
  m.def(
      "order",
      [](const Splats<T>& splats, Address order_, Address drawn, int threads) {
        order<T>(splats, at<int32_t>(order_), at<int64_t>(drawn), threads);
      },
      NoGil());
  m.def(
      "bin_count",
      [](const Splats<T>& splats, Address order_, Address drawn, int64_t height_px, const Bins& bins, int threads) {
        return bin_count<T>(splats, at<int32_t>(order_), at<int64_t>(drawn), height_px, bins, threads);
      },
      NoGil());
  m.def(
      "bin_fill",
      [](const Splats<T>& splats, Address order_, Address drawn, int64_t height_px, const Bins& bins, int threads) {
        bin_fill<T>(splats, at<int32_t>(order_), at<int64_t>(drawn), height_px, bins, threads);
      },
      NoGil());
  m.def(
      "first_pairs",
      [](const Splats<T>& splats, int64_t height_px, const Bins& bins, Address first_pair, int threads) {
        first_pairs<T>(splats, height_px, bins, at<int64_t>(first_pair), threads);
      },
      NoGil());
  m.def(
      "composite_dense",
      [](const Splats<T>& splats, const Bins& bins, const Cameras<T>& cameras, Address background,
         const DenseImages<T>& out,
         int threads) { return composite_dense<T>(splats, bins, cameras, at<T>(background), out, threads); },
      NoGil());
  m.def(
      "composite_dense_backward",
      [read_only](const Splats<T>& splats, const Bins& bins, const Cameras<T>& cameras, Address background,
                  const DenseImages<T>& images, const DenseImages<T>& gradients, Address first_pair,
                  Address pair_gradients, Address band_background, int threads) {
        return composite_dense_backward<T>(splats, bins, cameras, at<T>(background), read_only(images),
                                           read_only(gradients), at<int64_t>(first_pair), at<T>(pair_gradients),
                                           at<T>(band_background), threads);
      },
      NoGil());
  m.def(
      "composite_lens",
      [](const Splats<T>& splats, const Bins& bins, const Lens& lens, const Quality& quality, Address background,
         Address out, Address out8, int threads) {
        return composite_lens<T>(splats, bins, lens, quality, at<T>(background), at<T>(out), at<uint8_t>(out8),
                                 threads);
      },
      NoGil());
  m.def(
      "composite_lens_backward",
      [](const Splats<T>& splats, const Bins& bins, const Lens& lens, Address background, Address image,
         Address gradient, Address first_pair, Address pair_gradients, Address band_background, int threads) {
        return composite_lens_backward<T>(splats, bins, lens, at<T>(background), at<T>(image), at<T>(gradient),
                                          at<int64_t>(first_pair), at<T>(pair_gradients), at<T>(band_background),
                                          threads);
      },
      NoGil());
}

#ifdef LFGS_WITH_CUDA
// The device's stages. Streams and all pointers are integers, as on the CPU.
void bind_cuda(py::module_ m) {
  using G = Gaussians<float>;
  auto as_const = [](const G& g) {
    return Gaussians<const float>{g.count, g.sh_degree, g.means, g.quaternions, g.scales, g.opacities, g.sh};
  };
  m.attr("architectures") = cuda::architectures();
  py::class_<cuda::Image>(m, "Image")
      .def(py::init([](int64_t count, int64_t width_px, int64_t height_px, bool lens) {
             return cuda::Image{count, width_px, height_px, lens ? cuda::kLensTile : cuda::kDenseTile};
           }),
           py::arg("count"), py::arg("width_px"), py::arg("height_px"), py::arg("lens"))
      .def(py::init([](int64_t count, int64_t width_px, int64_t height_px, const SubpixelTile& tile) {
             return cuda::Image{count, width_px, height_px, {tile.width_px, tile.height_px()}};
           }),
           py::arg("count"), py::arg("width_px"), py::arg("height_px"), py::arg("tile"))
      .def("tiles", [](const cuda::Image& i) { return i.count * cuda::tile_count(i.tile, i.width_px, i.height_px); });
  m.def(
      "project_dense",
      [as_const](const G& g, const Cameras<float>& cameras, const Splats<float>& out, Address keys, Address stream) {
        cuda::project_dense(as_const(g), cameras, out, at<uint64_t>(keys), at<void>(stream));
      },
      NoGil());
  m.def(
      "project_lens",
      [as_const](const G& g, const View<double>& rig, const Lens& lens, double tolerance, const Splats<float>& out,
                 Address keys, Address error, Address stream) {
        cuda::project_lens(as_const(g), rig, lens, tolerance, out, at<uint64_t>(keys), at<float>(error),
                           at<void>(stream));
      },
      NoGil());
  m.def("order_bytes", &cuda::order_bytes);
  m.def(
      "order",
      [](int64_t items, int64_t images, Address keys, Address sorted, Address indices, Address temporary, size_t bytes,
         Address stream) {
        cuda::order(items, images, at<uint64_t>(keys), at<uint64_t>(sorted), at<uint32_t>(indices), at<void>(temporary),
                    bytes, at<void>(stream));
      },
      NoGil());
  m.def("count_bytes", &cuda::count_bytes);
  m.def(
      "bin_count",
      [](const Splats<float>& splats, const cuda::Image& image, Address counts, Address pairs, Address temporary,
         size_t bytes, Address stream) {
        cuda::bin_count(splats, image, at<uint32_t>(counts), at<int64_t>(pairs), at<void>(temporary), bytes,
                        at<void>(stream));
      },
      NoGil());
  m.def("fill_bytes", &cuda::fill_bytes);
  m.def("view_blocks", &cuda::view_blocks);
  m.attr("DENSE_SUMS") = cuda::kDenseSums;
  py::class_<cuda::Pairs>(m, "Pairs")
      .def(py::init([](int64_t count, Address tiles, Address sorted_tiles, Address slots, Address sorted_slots,
                       Address slot_splats, Address sorted_splats) {
             return cuda::Pairs{count,
                                at<uint32_t>(tiles),
                                at<uint32_t>(sorted_tiles),
                                at<uint32_t>(slots),
                                at<uint32_t>(sorted_slots),
                                at<uint32_t>(slot_splats),
                                at<uint32_t>(sorted_splats)};
           }),
           py::arg("count"), py::arg("tiles"), py::arg("sorted_tiles"), py::arg("slots"), py::arg("sorted_slots"),
           py::arg("slot_splats"), py::arg("sorted_splats"));
  m.def(
      "bin_fill",
      [](const Splats<float>& splats, const cuda::Image& image, Address indices, Address counts, Address ends,
         const cuda::Pairs& pairs, Address ranges, Address slot_ranges, Address temporary, size_t bytes,
         Address stream) {
        cuda::bin_fill(splats, image, at<uint32_t>(indices), at<uint32_t>(counts), at<int64_t>(ends), pairs,
                       at<int64_t>(ranges), at<cuda::SlotRange>(slot_ranges), at<void>(temporary), bytes,
                       at<void>(stream));
      },
      NoGil());
  m.def(
      "composite_dense",
      [](const Splats<float>& splats, const cuda::Image& image, Address ranges, const cuda::Pairs& pairs,
         Address background, const DenseImages<float>& out, Address stream) {
        cuda::composite_dense(splats, image, at<int64_t>(ranges), pairs, at<float>(background), out, at<void>(stream));
      },
      NoGil());
  m.def(
      "composite_lens",
      [](const Splats<float>& splats, const cuda::Image& image, Address ranges, const cuda::Pairs& pairs,
         const Lens& lens, Address background, Address out, Address stream) {
        cuda::composite_lens(splats, image, at<int64_t>(ranges), pairs, lens, at<float>(background), at<float>(out),
                             at<void>(stream));
      },
      NoGil());
  auto read_only = [](const DenseImages<float>& i) { return DenseImages<const float>{i.image, i.alpha, i.depth}; };
  m.def(
      "composite_dense_backward",
      [read_only](const Splats<float>& splats, const cuda::Image& image, Address ranges, const cuda::Pairs& pairs,
                  const DenseImages<float>& images, const DenseImages<float>& gradients, Address slot_gradients,
                  Address tile_background, Address stream) {
        cuda::composite_dense_backward(splats, image, at<int64_t>(ranges), pairs, read_only(images),
                                       read_only(gradients), at<float>(slot_gradients), at<float>(tile_background),
                                       at<void>(stream));
      },
      NoGil());
  m.def(
      "project_dense_backward",
      [as_const](const G& g, const Cameras<float>& cameras, const Splats<float>& splats, Address slot_ranges,
                 Address slot_gradients, const G& out, Address view_partials, Address stream) {
        cuda::project_dense_backward(as_const(g), cameras, splats, at<cuda::SlotRange>(slot_ranges),
                                     at<float>(slot_gradients), out, at<float>(view_partials), at<void>(stream));
      },
      NoGil());
  m.attr("LENS_SUMS") = cuda::kLensSums;
  m.def(
      "composite_lens_backward",
      [](const Splats<float>& splats, const cuda::Image& image, Address ranges, const cuda::Pairs& pairs,
         const Lens& lens, Address pixels, Address gradient, Address slot_gradients, Address tile_background,
         Address stream) {
        cuda::composite_lens_backward(splats, image, at<int64_t>(ranges), pairs, lens, at<float>(pixels),
                                      at<float>(gradient), at<float>(slot_gradients), at<float>(tile_background),
                                      at<void>(stream));
      },
      NoGil());
  m.def(
      "project_lens_backward",
      [as_const](const G& g, const View<double>& rig, const Splats<float>& splats, Address slot_ranges,
                 Address slot_gradients, const G& out, Address stream) {
        cuda::project_lens_backward(as_const(g), rig, splats, at<cuda::SlotRange>(slot_ranges),
                                    at<float>(slot_gradients), out, at<void>(stream));
      },
      NoGil());
  m.def(
      "group_norm_silu",
      [](int64_t images, int64_t pixels, int channels, int groups, Address in, Address weight, Address bias, float eps,
         Address out, Address stream) {
        cuda::group_norm_silu({images, pixels, channels, groups}, at<uint32_t>(in), at<uint32_t>(weight),
                              at<uint32_t>(bias), eps, at<uint32_t>(out), at<void>(stream));
      },
      NoGil());
}
#endif

// What this processor can run of what was compiled: scalar code always, where it was (LFGS_SCALAR).
int64_t usable_targets() { return (hwy::SupportedTargets() | HWY_EMU128) & HWY_TARGETS; }

std::vector<std::string> simd_targets() {
  std::vector<std::string> names;
  for (int64_t left = usable_targets(); left; left &= left - 1) names.push_back(hwy::TargetName(left & -left));
  return names;
}

// Restricts run-time dispatch to one vector instruction set ("" for the best there is).
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
}  // namespace lfgs

PYBIND11_MODULE(_core, m) {
  using namespace lfgs;
  m.doc() = "Native core of lightfield_gs; use lightfield_gs.ops instead.";
  py::register_exception_translator([](std::exception_ptr p) {
    try {
      if (p) std::rethrow_exception(p);
    } catch (const Error& e) {
      PyErr_SetString(PyExc_ValueError, e.what());
    }
  });
  m.attr("version") = LFGS_VERSION;
  m.attr("BAND_ROWS") = kBandRows;
  m.attr("SPLAT_FIELDS") = kSplatFields;
  m.attr("PRUNED") = kPruned;
  m.attr("NEAR_DEPTH") = kNearDepth;
  m.attr("COLOUR_STRIDE") = kColourStride;
  m.attr("CELL_SUBPIXELS") = kCellPeriod * kRowPeriod;
  m.def("band_count", &band_count);
  m.attr("COMPENSATION_FIELDS") = kCompensationFields;
  m.def("pair_gradient_size", &pair_gradient_size, py::arg("colour_order"), py::arg("compensated") = false);
  m.def("simd_targets", &simd_targets);
  m.def("set_simd_target", &set_simd_target);

  py::class_<Lens>(m, "Lens")
      .def(py::init([](int64_t width_px, int64_t height_px, int64_t views, uint64_t phase0, uint64_t phase_x,
                       uint64_t phase_y, double line_number, double slant_tan, double phase, bool bgr, bool continuous,
                       double offset_start, double offset_step, const std::vector<uint64_t>& cell_phases,
                       const std::vector<int>& cell_channels) {
             Lens lens{width_px, height_px, views,      phase0,       phase_x,     phase_y, line_number, slant_tan,
                       phase,    bgr,       continuous, offset_start, offset_step, false,   {}};
             lens.set_cells(cell_phases, cell_channels);
             return lens;
           }),
           py::kw_only(), py::arg("width_px"), py::arg("height_px"), py::arg("views"), py::arg("phase0"),
           py::arg("phase_x"), py::arg("phase_y"), py::arg("line_number"), py::arg("slant_tan"), py::arg("phase"),
           py::arg("bgr"), py::arg("continuous"), py::arg("offset_start"), py::arg("offset_step"),
           py::arg("cell_phases") = std::vector<uint64_t>(), py::arg("cell_channels") = std::vector<int>())
      .def("reach", &Lens::reach)
      .def("subpixel_of", &Lens::subpixel_of)
      .def("stands_in_order", &Lens::stands_in_order)
      .def("has_one_order", &Lens::has_one_order)
      .def("view_at", [](const Lens& lens, int64_t row, int64_t subpixel) {
        return integer_view(lens.true_phase(row, subpixel), uint64_t(lens.views));
      });
  py::class_<View<double>>(m, "Rig").def(py::init(&view_of), py::kw_only(), py::arg("world_to_camera"),
                                         py::arg("intrinsics"), py::arg("limits"), py::arg("zero_depth"),
                                         py::arg("lens"), py::arg("antialiased") = false);
  py::class_<Quality>(m, "Quality")
      .def(py::init([](double opacity_cut, double transmittance_stop, double lattice, double contribution,
                       double evaluation) {
             return Quality{opacity_cut * 255 > 1 ? std::log2(opacity_cut) : kLog2MinAlpha,
                            std::max(transmittance_stop, kMinTransmittance), lattice, contribution, evaluation};
           }),
           py::kw_only(), py::arg("opacity_cut"), py::arg("transmittance_stop"), py::arg("lattice"),
           py::arg("contribution"), py::arg("evaluation"));
  py::class_<Bins>(m, "Bins").def(
      py::init([](Address offsets, Address splats) { return Bins{at<int64_t>(offsets), at<int32_t>(splats)}; }),
      py::arg("band_offsets"), py::arg("band_splats"));
  py::class_<Counters>(m, "Counters")
      .def_readonly("pairs", &Counters::pairs)
      .def_readonly("evaluations", &Counters::evaluations)
      .def_readonly("scratch_bytes", &Counters::scratch_bytes)
      .def_readonly("tiles", &Counters::tiles)
      .def_readonly("empty_tiles", &Counters::empty_tiles)
      .def_readonly("stopped_samples", &Counters::stopped_samples)
      .def_readonly("lattice_tiles", &Counters::lattice_tiles)
      .def_readonly("lattices", &Counters::lattices)
      .def_readonly("split_lattices", &Counters::split_lattices)
      .def_readonly("refused_lattices", &Counters::refused_lattices);

  bind_stages<float>(m.def_submodule("float32"));
  bind_stages<double>(m.def_submodule("float64"));
#ifdef LFGS_WITH_CUDA
  py::module_ cuda_module = m.def_submodule("cuda");
  bind_cuda(cuda_module);
  bind_lens_frame(cuda_module);
#endif
  bind_sorted(m);
}
