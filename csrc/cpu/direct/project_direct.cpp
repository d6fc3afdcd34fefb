// Stage project for the panel, and its backward pass. It projects Gaussians by the rig to splats, whose colours are
// polynomials in the offset, or on circles near the cameras. The backward pass takes the gradients of intersections to
// the gradients of Gaussians.
#include <algorithm>
#include <vector>

#include "base/parallel.h"
#include "cpu/gaussian_io.h"
#include "math/colour_circle.h"
#include "math/colour_polynomial.h"
#include "math/harmonics.h"
#include "math/rig_gradient.h"
#include "stages/stages.h"

namespace lfgs {

using glm::dvec3;

namespace {

constexpr double kDoubleColourError = 1e-12;

// Store the colour of a splat on its circle.
template <class T>
void store_on_circle(int degree, const T* sh, const ColourCircle<double>& circle, T* colours) {
  dvec3 terms[kCircleTerms];
  circle_colour(degree, sh, circle, terms);
  for (int m = 0; m < kCircleTerms; ++m)
    for (int c = 0; c < 3; ++c) colours[m * kColourStride + c] = T(terms[m][c]);
  colours[kPlaceTerm * kColourStride + 3] = T(circle.place);
  colours[kDistanceTerm * kColourStride + 3] = T(circle.distance);
}

}  // namespace

template <class T>
double project_direct(const Gaussians<const T>& gaussians, const Camera<double>& rig, const Lens& lens,
                      const Quality& quality, double tolerance, const Splats<T>& out, int threads) {
  const int64_t n = gaussians.count;
  const int order = out.colour_order, nodes = order + 1;
  const ColourBasis basis(order);
  // The largest error of interpolation. Double precision, the exact twin, gives nothing up.
  const double most = sizeof(T) == 4 ? tolerance : std::min(tolerance, kDoubleColourError);
  const bool varies = order > 0 && rig.sweep > 0;
  const double least_light = quality.least_light(lens.width_px, lens.height_px, n);
  std::vector<double> worst(std::max(threads, 1), 0.0);
  parallel_for_chunks(n, kGrain, threads, [&](int64_t begin, int64_t end, int worker) {
    std::vector<dvec3> chebyshev(nodes);
    for (int64_t i = begin; i < end; ++i) {
      // The splat, unless it is pruned or outside the image
      const Shape<double> shape = load_shape<double>(gaussians, i);
      Compensation<double> compensation{};
      Splat<double> splat = projected(rig, shape, compensation);
      const bool pruned = least_light > 0 && alpha_integral(splat) < least_light;
      if (quality.log2_cut > kLog2MinAlpha && !(quality.lattice > 0))
        raise_cut(splat, quality.log2_cut, quality.approximate());
      cull_outside(splat, lens.width_px, lens.height_px);
      if (pruned && splat.reach_y >= 0) splat.reach_y = kPruned;
      out.splats[i] = splat_cast<T>(splat);
      out.orders[i] = 0;
      if (out.compensations) out.compensations[i] = {T(compensation.D0), T(compensation.D1), T(compensation.D2)};
      if (splat.reach_y < 0) continue;

      // The colour on its circle, where a polynomial would err too much
      const T* sh = gaussians.sh + 3 * gaussians.sh_count() * i;
      T* colours = out.colours + i * nodes * kColourStride;
      double error = 0;
      if (varies) {
        const ColourCircle<double> circle(rig, shape.mean);
        error = circle_tail(order, circle_amplitudes<double>(gaussians.sh_degree, sh), circle.place, circle.distance);
        if (error > most && order >= kLeastCircleOrder) {
          out.orders[i] = kCircleOrder;
          store_on_circle(gaussians.sh_degree, sh, circle, colours);
          continue;
        }
      }

      // The colour polynomial
      auto value = [&](double s) { return sh_colour<double>(gaussians.sh_degree, sh, shape.mean, rig.eye_at(s)); };
      chebyshev_of_values(basis, nodes, value, chebyshev.data());
      auto size = [&](int k) {
        return std::max({std::abs(chebyshev[k].x), std::abs(chebyshev[k].y), std::abs(chebyshev[k].z)});
      };

      // Drop the orders that this splat does not need. In double nothing is dropped.
      int kept = order;
      double dropped = 0;
      if (sizeof(T) == 4)
        for (; kept > 0 && dropped + size(kept) <= tolerance; --kept) dropped += size(kept);
      worst[worker] = std::max(worst[worker], error + dropped);
      out.orders[i] = kept;
      for (int p = 0; p <= kept; ++p) {
        const dvec3 power = power_of_chebyshev(basis, nodes, p, kept, p, kept + 1, chebyshev.data());
        for (int c = 0; c < 3; ++c) colours[p * kColourStride + c] = T(kept ? power[c] : std::max(0.0, power[c]));
      }
    }
  });
  return *std::max_element(worst.begin(), worst.end());
}

template <class T>
void project_direct_backward(const Gaussians<const T>& gaussians, const Camera<double>& rig, const Lens& lens,
                             const Splats<T>& splats, const int64_t* first_intersection,
                             const T* intersection_gradients, const Gaussians<T>& out, double* g_rig, int threads) {
  const int order = splats.colour_order, nodes = order + 1, size = intersection_gradient_size(order, rig.compensated());
  const ColourBasis basis(order);
  std::vector<RigGradient> partial(g_rig ? size_t((gaussians.count + kGrain - 1) / kGrain) : 0);
  parallel_for_chunks(gaussians.count, kGrain, threads, [&](int64_t begin, int64_t end, int) {
    std::vector<double> sum(size);
    const IntersectionGradient<double> g_intersection{sum.data(), order};
    std::vector<dvec3> g_chebyshev(nodes);
    RigGradient unused, &of_rig = g_rig ? partial[size_t(begin / kGrain)] : unused;
    OpticsGradient<double>* of_optics = g_rig ? &of_rig.optics : nullptr;
    for (int64_t i = begin; i < end; ++i) {
      const Splat<T>& splat = splats.splats[i];
      if (splat.reach_y < 0) continue;
      sum_intersections(splat, lens.height_px, first_intersection[i], size, intersection_gradients, sum.data());

      // The gradient of the splat, back to the Gaussian
      const Shape<double> shape = load_shape<double>(gaussians, i);
      Shape<double> g{dvec3(0), glm::dvec4(0), dvec3(0), 0};
      const Projection<double> projection(rig, shape);
      const Splat<double> g_splat = g_intersection.splat();
      if (rig.compensated()) {
        Splat<double> again = projection.splat(rig, shape.opacity);
        Compensation<double> unused_D;
        const double most = projection.compensate(rig, again, unused_D);
        const Compensation<double>& g_compensation = g_intersection.compensation();
        projection.backward<true>(rig, shape, g_splat, g, of_rig.pose,
                                  {g_compensation.D0 / most, g_compensation.D1 / most, g_compensation.D2 / most},
                                  of_optics);
      } else {
        projection.backward(rig, shape, g_splat, g, of_rig.pose, {}, of_optics);
      }

      // The gradient of the colours, back to harmonics and mean
      const T* colours = splats.colours + i * nodes * kColourStride;
      const int64_t first = 3 * gaussians.sh_count() * i;
      if (splats.orders[i] == kCircleOrder) {
        const ColourCircle<double> circle(rig, shape.mean);
        CircleGradient<double> g_circle;
        const dvec3 g_mean = circle_colour_backward(gaussians.sh_degree, gaussians.sh + first, circle,
                                                    g_intersection.colours(), out.sh + first, &g_circle);
        g.mean += g_mean;
        if (g_rig) of_rig.add_circle(rig, circle, g_circle, g_mean);
        add_gradient(shape, g, out, i);
        continue;
      }
      auto to_harmonics = [&](double s, const dvec3& g_value) {
        const dvec3 g_mean = sh_colour_backward(gaussians.sh_degree, gaussians.sh + first, shape.mean, rig.eye_at(s),
                                                g_value, out.sh + first);
        g.mean += g_mean;
        if (g_rig) of_rig.add_eye(rig, s, -g_mean);
      };
      colour_fit_backward(basis, nodes, splats.orders[i], g_intersection.colours(), colours, g_chebyshev.data(),
                          to_harmonics);
      add_gradient(shape, g, out, i);
    }
  });
  if (!g_rig) return;
  RigGradient all;
  for (const RigGradient& one : partial) all += one;
  all.to_pose(rig);
  for (int k = 0; k < kRigNumbers; ++k) g_rig[k] = all.number(k);
}

#define LFGS_INSTANTIATE(T)                                                                                       \
  template double project_direct(const Gaussians<const T>&, const Camera<double>&, const Lens&, const Quality&,   \
                                 double, const Splats<T>&, int);                                                  \
  template void project_direct_backward(const Gaussians<const T>&, const Camera<double>&, const Lens&,            \
                                        const Splats<T>&, const int64_t*, const T*, const Gaussians<T>&, double*, \
                                        int);
LFGS_INSTANTIATE(float)
LFGS_INSTANTIATE(double)

}  // namespace lfgs
