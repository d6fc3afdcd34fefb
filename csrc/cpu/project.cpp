// Stage project and its reverse. Arithmetic is double whatever the precision of the data: it costs a few milliseconds
// and keeps needles and far-away means exact.
#include <algorithm>
#include <atomic>
#include <vector>

#include "base/parallel.h"
#include "math/colour_polynomial.h"
#include "math/footprint.h"
#include "math/harmonics.h"
#include "math/saturate.h"
#include "stages/stages.h"

namespace lfgs {
namespace {

using glm::dvec3;
constexpr int64_t kGrain = 1024;  // Gaussians per work item; fixed, so that sums do not depend on the thread count

template <class T>
Shape<double> shape_of(const Gaussians<const T>& g, int64_t i) {
  const T *m = g.means + 3 * i, *q = g.quaternions + 4 * i, *s = g.scales + 3 * i;
  return {{m[0], m[1], m[2]}, {q[0], q[1], q[2], q[3]}, {s[0], s[1], s[2]}, double(g.opacities[i])};
}

// Gradient of one pair summed over the bands of a splat, in band order.
template <class T>
void sum_pairs(const Splat<T>& splat, int64_t height_px, int64_t first, int size, const T* pairs, double* sum) {
  Range rows = rows_of(splat, height_px);
  std::fill(sum, sum + size, 0.0);
  if (rows.last < rows.first) return;
  int64_t bands = rows.last / kBandRows - rows.first / kBandRows + 1;
  for (int64_t k = 0; k < bands; ++k)
    for (int f = 0; f < size; ++f) sum[f] += double(pairs[(first + k) * size + f]);
}

// A splat and, of an anti-aliased scene, its compensation.
Splat<double> projected(const View<double>& view, const Shape<double>& shape, Compensation<double>& compensation) {
  const Projection<double> projection(view, shape);
  Splat<double> splat = projection.splat(view, shape.opacity);
  if (view.antialiased && splat.reach_y >= 0) projection.compensate(splat, compensation);
  return splat;
}

Splat<double> splat_gradient(const double* g) {
  return {g[0], g[1], g[2], g[3], g[4], g[5], g[6], g[7], g[8], g[9], g[10], g[11]};
}

template <class T>
void add(const Shape<double>& shape, const Shape<double>& g, const Gaussians<T>& out, int64_t i) {
  const glm::dvec4 g_quaternion = quaternion_gradient(shape.quaternion, g.quaternion);
  auto add_to = [](T& sum, double value) { sum = saturated<T>(double(sum) + value); };
  for (int c = 0; c < 3; ++c) add_to(out.means[3 * i + c], g.mean[c]), add_to(out.scales[3 * i + c], g.scale[c]);
  for (int c = 0; c < 4; ++c) add_to(out.quaternions[4 * i + c], g_quaternion[c]);
  add_to(out.opacities[i], g.opacity);
}

dvec3 eye_at(const View<double>& rig, const Lens& lens, double s) {
  dvec3 right(rig.rotation[0][0], rig.rotation[1][0], rig.rotation[2][0]);
  return rig.centre() + s * lens.reach() * right;
}

}  // namespace

template <class T>
void project_dense(const Gaussians<const T>& gaussians, const Cameras<T>& cameras, const Splats<T>& out, int threads) {
  const int64_t n = gaussians.count, chunks = (n + kGrain - 1) / kGrain;
  parallel_for(cameras.images() * chunks, threads, [&](int64_t item, int) {
    const int64_t image = item / chunks, begin = item % chunks * kGrain, end = std::min(n, begin + kGrain);
    const Gaussians<const T> scene = gaussians.slice(image / cameras.per_scene * n);
    const View<double> view = cameras.view(image);
    const dvec3 eye = view.centre();
    for (int64_t i = begin; i < end; ++i) {
      const Shape<double> shape = shape_of(scene, i);
      Compensation<double> unused;
      Splat<double> splat = projected(view, shape, unused);
      cull_outside(splat, cameras.width_px, cameras.height_px);
      out.splats[image * n + i] = splat_cast<T>(splat);
      T* stored = out.colours + (image * n + i) * kColourStride;
      std::fill_n(stored, kColourStride, T(0));
      if (splat.reach_y < 0) continue;
      const dvec3 colour = sh_colour<double>(scene.sh_degree, scene.sh + 3 * scene.sh_count() * i, shape.mean, eye);
      for (int c = 0; c < 3; ++c) stored[c] = T(std::max(0.0, colour[c]));
    }
  });
}

template <class T>
void project_dense_backward(const Gaussians<const T>& gaussians, const Cameras<T>& cameras, const Splats<T>& splats,
                            const int64_t* first_pair, const T* pair_gradients, const Gaussians<T>& out,
                            T* g_world_to_camera, int threads) {
  const int64_t n = gaussians.count, chunks = (n + kGrain - 1) / kGrain;
  const int size = pair_gradient_size(0);
  std::vector<ViewAdjoint<double>> partial(cameras.images() * chunks);

  // A scene's Gaussians in chunks; the cameras of the scene in order
  parallel_for(cameras.scenes * chunks, threads, [&](int64_t item, int) {
    const int64_t b = item / chunks, begin = item % chunks * kGrain, end = std::min(n, begin + kGrain);
    const Gaussians<const T> scene = gaussians.slice(b * n);
    const Gaussians<T> g_scene = out.slice(b * n);
    std::vector<double> sum(size);
    std::vector<Shape<double>> over_views(end - begin, Shape<double>{dvec3(0), glm::dvec4(0), dvec3(0), 0});
    for (int64_t v = 0; v < cameras.per_scene; ++v) {
      const int64_t image = b * cameras.per_scene + v;
      const View<double> view = cameras.view(image);
      const dvec3 eye = view.centre();
      ViewAdjoint<double>& g_view = partial[image * chunks + item % chunks];
      dvec3 g_eye(0);
      for (int64_t i = begin; i < end; ++i) {
        const Splat<T>& splat = splats.splats[image * n + i];
        if (splat.reach_y < 0) continue;
        sum_pairs(splat, cameras.height_px, first_pair[image * n + i], size, pair_gradients, sum.data());
        const Shape<double> shape = shape_of(scene, i);
        Shape<double>& g = over_views[i - begin];
        const Projection<double> projection(view, shape);
        Splat<double> g_splat = splat_gradient(sum.data());
        if (view.antialiased) {
          const Compensation<double> g_sharp = projection.compensate_adjoint(g_splat);
          projection.adjoint<true>(view, shape, g_splat, g, g_view, g_sharp);
        } else {
          projection.adjoint(view, shape, g_splat, g, g_view);
        }

        // Colours, through their clamp at zero
        const T* colour = splats.colours + (image * n + i) * kColourStride;
        dvec3 g_colour(0);
        for (int c = 0; c < 3; ++c) g_colour[c] = colour[c] > 0 ? sum[kSplatFields + c] : 0.0;
        const int64_t k = 3 * scene.sh_count() * i;
        const dvec3 g_mean =
            sh_colour_adjoint(scene.sh_degree, scene.sh + k, shape.mean, eye, g_colour, g_scene.sh + k);
        g.mean += g_mean;
        g_eye -= g_mean;
      }
      // eye = -R^T t
      g_view.rotation += glm::outerProduct(-view.translation, g_eye);
      g_view.translation -= view.rotation * g_eye;
    }
    for (int64_t i = begin; i < end; ++i) add(shape_of(scene, i), over_views[i - begin], g_scene, i);
  });

  for (int64_t image = 0; image < cameras.images(); ++image) {
    ViewAdjoint<double> g;
    for (int64_t c = 0; c < chunks; ++c) {
      g.rotation += partial[image * chunks + c].rotation;
      g.translation += partial[image * chunks + c].translation;
    }
    T* m = g_world_to_camera + 16 * image;
    for (int row = 0; row < 3; ++row) {
      for (int col = 0; col < 3; ++col) m[4 * row + col] = T(g.rotation[col][row]);
      m[4 * row + 3] = T(g.translation[row]);
    }
  }
}

template <class T>
double project_lens(const Gaussians<const T>& gaussians, const View<double>& rig, const Lens& lens,
                    const Quality& quality, double tolerance, const Splats<T>& out, int threads) {
  const int64_t n = gaussians.count;
  const int order = out.colour_order, nodes = order + 1;
  const ColourBasis basis(order);
  const double least_light = quality.least_light(lens.width_px, lens.height_px, n);
  std::vector<double> worst(std::max(threads, 1), 0.0);
  parallel_for_chunks(n, kGrain, threads, [&](int64_t begin, int64_t end, int worker) {
    std::vector<dvec3> value(nodes), chebyshev(nodes);
    for (int64_t i = begin; i < end; ++i) {
      const Shape<double> shape = shape_of(gaussians, i);
      Compensation<double> compensation{};
      Splat<double> splat = projected(rig, shape, compensation);
      const bool pruned = least_light > 0 && light_of(splat) < least_light;
      if (quality.log2_cut > kLog2MinAlpha && !(quality.lattice > 0))
        raise_cut(splat, quality.log2_cut, quality.rough());
      cull_outside(splat, lens.width_px, lens.height_px);
      if (pruned && splat.reach_y >= 0) splat.reach_y = kPruned;
      out.splats[i] = splat_cast<T>(splat);
      out.orders[i] = 0;
      if (out.compensations) out.compensations[i] = {T(compensation.D0), T(compensation.D1), T(compensation.D2)};
      if (splat.reach_y < 0) continue;

      // Values at the nodes -> Chebyshev coefficients
      const T* sh = gaussians.sh + 3 * gaussians.sh_count() * i;
      for (int j = 0; j < nodes; ++j)
        value[j] = sh_colour<double>(gaussians.sh_degree, sh, shape.mean, eye_at(rig, lens, basis.nodes[j]));
      for (int k = 0; k < nodes; ++k) {
        chebyshev[k] = dvec3(0);
        for (int j = 0; j < nodes; ++j) chebyshev[k] += basis.to_chebyshev[k * nodes + j] * value[j];
      }
      auto size = [&](int k) {
        return std::max({std::abs(chebyshev[k].x), std::abs(chebyshev[k].y), std::abs(chebyshev[k].z)});
      };
      if (order >= 2) worst[worker] = std::max(worst[worker], size(order) + size(order - 1));

      // Drop the orders this splat does not need. In double nothing is dropped: that is the exact twin.
      int kept = order;
      if (sizeof(T) == 4)
        for (double dropped = 0; kept > 0 && (dropped += size(kept)) <= tolerance;) --kept;
      out.orders[i] = kept;
      T* colours = out.colours + i * nodes * kColourStride;
      for (int p = 0; p <= kept; ++p) {
        dvec3 power(0);
        for (int k = p; k <= kept; ++k) power += basis.to_powers[p * nodes + k] * chebyshev[k];
        for (int c = 0; c < 3; ++c) colours[p * kColourStride + c] = T(kept ? power[c] : std::max(0.0, power[c]));
      }
    }
  });
  return *std::max_element(worst.begin(), worst.end());
}

template <class T>
void project_lens_backward(const Gaussians<const T>& gaussians, const View<double>& rig, const Lens& lens,
                           const Splats<T>& splats, const int64_t* first_pair, const T* pair_gradients,
                           const Gaussians<T>& out, int threads) {
  const int order = splats.colour_order, nodes = order + 1, size = pair_gradient_size(order, rig.antialiased);
  const ColourBasis basis(order);
  parallel_for_chunks(gaussians.count, kGrain, threads, [&](int64_t begin, int64_t end, int) {
    std::vector<double> sum(size);
    std::vector<dvec3> g_chebyshev(nodes);
    ViewAdjoint<double> unused;
    for (int64_t i = begin; i < end; ++i) {
      const Splat<T>& splat = splats.splats[i];
      if (splat.reach_y < 0) continue;
      sum_pairs(splat, lens.height_px, first_pair[i], size, pair_gradients, sum.data());
      const Shape<double> shape = shape_of(gaussians, i);
      Shape<double> g{dvec3(0), glm::dvec4(0), dvec3(0), 0};
      const Projection<double> projection(rig, shape);
      const Splat<double> g_splat = splat_gradient(sum.data());
      if (rig.antialiased) {
        Splat<double> again = projection.splat(rig, shape.opacity);
        Compensation<double> sharp;
        const double most = projection.compensate(again, sharp), *g_sharp = &sum[size_t(size - kCompensationFields)];
        projection.adjoint<true>(rig, shape, g_splat, g, unused,
                                 {g_sharp[0] / most, g_sharp[1] / most, g_sharp[2] / most});
      } else {
        projection.adjoint(rig, shape, g_splat, g, unused);
      }

      // Powers of s -> Chebyshev -> node values -> harmonics
      const int kept = splats.orders[i];
      const T* colours = splats.colours + i * nodes * kColourStride;
      for (int k = 0; k <= kept; ++k) {
        g_chebyshev[k] = dvec3(0);
        for (int p = 0; p <= k; ++p)
          for (int c = 0; c < 3; ++c)
            if (kept || colours[c] > 0)
              g_chebyshev[k][c] += basis.to_powers[p * nodes + k] * sum[kSplatFields + 3 * p + c];
      }
      const int64_t first = 3 * gaussians.sh_count() * i;
      for (int j = 0; j < nodes; ++j) {
        dvec3 g_value(0);
        for (int k = 0; k <= kept; ++k) g_value += basis.to_chebyshev[k * nodes + j] * g_chebyshev[k];
        g.mean += sh_colour_adjoint(gaussians.sh_degree, gaussians.sh + first, shape.mean,
                                    eye_at(rig, lens, basis.nodes[j]), g_value, out.sh + first);
      }
      add(shape, g, out, i);
    }
  });
}

#define LFGS_INSTANTIATE(T)                                                                                            \
  template void project_dense(const Gaussians<const T>&, const Cameras<T>&, const Splats<T>&, int);                    \
  template double project_lens(const Gaussians<const T>&, const View<double>&, const Lens&, const Quality&, double,    \
                               const Splats<T>&, int);                                                                 \
  template void project_dense_backward(const Gaussians<const T>&, const Cameras<T>&, const Splats<T>&, const int64_t*, \
                                       const T*, const Gaussians<T>&, T*, int);                                        \
  template void project_lens_backward(const Gaussians<const T>&, const View<double>&, const Lens&, const Splats<T>&,   \
                                      const int64_t*, const T*, const Gaussians<T>&, int);
LFGS_INSTANTIATE(float)
LFGS_INSTANTIATE(double)

}  // namespace lfgs
