// Projection of one Gaussian for a panel on the device; the common part of project_direct and frame_project. It reads a
// Gaussian, and writes its splat, its colour polynomial and, if asked, its depth. Arithmetic is in float. The position
// of the mean and the shapes of compensated splats are in double.
#pragma once

#include <string>
#include <type_traits>

#include "base/error.h"
#include "cuda/stages/projection.cuh"
#include "cuda/common/gaussian_io.cuh"
#include "cuda/common/halves.cuh"
#include "cuda/direct/rounded_rig.cuh"
#include "math/colour_circle.h"
#include "math/footprint.h"
#include "math/harmonics.h"
#include "stages/stages.h"

namespace lfgs::cuda {

// A bound for the error of a colour that is interpolated at the three nodes of order 2, f''' / 24. Cameras on a line
// see a mean from directions on a great circle. On it, the harmonics above band 0 are a trigonometric polynomial of
// degree 3. By the addition theorem it is at most sqrt(15 / 4 pi) times their norm. Its derivatives are at most 3, 9
// and 27 times as much (Bernstein). The angle on the circle is an arctangent of s, whose derivatives are at most slope,
// 0.65 slope^2 and 2 slope^3.
__device__ inline float parabola_error(const float (&sh)[3 * kMaxShCount], const glm::vec3& mean,
                                       const Camera<float>& rig) {
  constexpr float kBound = 2.31f;
  float square = 0;
#pragma unroll
  for (int k = 3; k < 3 * kMaxShCount; ++k) square = fmaf(sh[k], sh[k], square);
  const glm::vec3 right = rig.eye_at(1) - rig.centre(), across = glm::cross(mean - rig.centre(), right);
  const float reach = glm::dot(right, right), slope = reach * rsqrtf(glm::dot(across, across));
  return reach > 0 ? kBound * slope * slope * slope * sqrtf(square) : 0.f;
}

// The colour of a Gaussian on its circle. It reads its inputs anew: few Gaussians need it, and the others should not
// keep registers for it. The circle is found in double, since the mean is near the cameras.
struct CircleOfGaussian {
  ColourCircle<float> circle;
  glm::vec3 terms[kCircleTerms];

  __device__ CircleOfGaussian(const Gaussians<const float>& g, const Camera<double>& rig, int64_t i)
      : circle(ColourCircle<double>(rig, glm::dvec3(load_shape<float>(g, i).mean))) {
    circle_colour(g.sh_degree, g.sh + 3 * g.sh_count() * i, circle, terms);
  }
};

// Store the colour of one drawn splat on its circle. The fourth number of the first term stands for the order. It is
// larger than any order, so kernels that know only polynomials skip it.
__device__ inline __noinline__ void store_on_circle(const Gaussians<const float> gaussians, const Camera<double>& rig,
                                                    int64_t i, const Splats<float> out) {
  constexpr float kNoOrder = 1000;
  const CircleOfGaussian colour(gaussians, rig, i);
  float4* terms = reinterpret_cast<float4*>(out.colours) + i * (out.colour_order + 1);
  for (int m = 0; m < kCircleTerms; ++m) {
    const glm::vec3& term = colour.terms[m];
    const float fourth = m == kPlaceTerm ? colour.circle.place : m == kDistanceTerm ? colour.circle.distance : 0;
    terms[m] = make_float4(term.x, term.y, term.z, m == 0 ? kNoOrder : fourth);
  }
  out.orders[i] = kCircleOrder;
}

// Allowed errors of a colour. Beyond the error of interpolation the colour is on a circle, if the array holds one. The
// other is allowed for dropping powers.
struct ColourLimits {
  float interpolated, left_out;
};

// Store the colour polynomial of one drawn splat. Values at the nodes give Chebyshev coefficients, and these the powers
// of s that it needs. Powers up to the second are always written, as zeros where it has none. The fourth number of the
// first power repeats the order, so that a kernel that reads colours does not wait for it. Where that would err too
// much, the colour is stored on its circle. watch(circle, amplitudes) is told of every colour of an order above 2,
// since parabolas need no watching.
template <int Order, class Watch>
__device__ inline void store_colours(const Gaussians<const float>& gaussians, const glm::vec3& mean,
                                     const RoundedRig& rigs, const BasisTable& basis, const ColourLimits& limits,
                                     int64_t i, const Splats<float>& out, unsigned* error, const Watch& watch) {
  constexpr int kNodes = Order + 1;
  const Camera<float>& rig = rigs.rounded;

  // Chebyshev coefficients
  float sh[3 * kMaxShCount];  // read once, in registers
  read_harmonics(gaussians, i, sh);
  float left = 0;
  if constexpr (Order == 2) {
    left = parabola_error(sh, mean, rig);
  } else if (rig.sweep > 0) {
    const ColourCircle<float> circle(rig, mean);
    const glm::vec3 amplitudes = circle_amplitudes<float>(3, sh);
    left = circle_tail(Order, amplitudes, circle.place, circle.distance);
    watch(circle, amplitudes);
    if (Order >= kLeastCircleOrder && left > limits.interpolated) return store_on_circle(gaussians, rigs.exact, i, out);
  }
  glm::vec3 chebyshev[kNodes];
  auto value = [&](float s) { return sh_colour<float>(3, sh, mean, rig.eye_at(s)); };
  chebyshev_of_values(basis, kNodes, value, chebyshev);
  auto size = [&](int k) { return fmaxf(fabsf(chebyshev[k].x), fmaxf(fabsf(chebyshev[k].y), fabsf(chebyshev[k].z))); };

  // Drop as many of the last coefficients as the tolerance allows
  int kept = Order;
  float dropped = 0, left_out = 0;
#pragma unroll
  for (int k = Order; k > 0; --k) {
    dropped += size(k);
    if (dropped <= limits.left_out && kept == k) kept = k - 1, left_out = dropped;
  }

  // The bound of the error, of which the frame keeps the largest. It is positive, so its bits order like the numbers
  const unsigned bits = __float_as_uint(left + left_out);
  if (bits > *static_cast<volatile unsigned*>(error)) atomicMax(error, bits);

  // Store the powers
  out.orders[i] = kept;
  float4* colours = reinterpret_cast<float4*>(out.colours) + i * kNodes;
#pragma unroll 1
  for (int p = 0; p <= kept; ++p) {
    glm::vec3 power = power_of_chebyshev(basis, kNodes, p, kept, 0, kNodes, chebyshev);
    if (kept == 0) power = glm::max(power, glm::vec3(0));
    colours[p] = make_float4(power.x, power.y, power.z, p == 0 ? float(kept) : 0.f);
  }
  for (int p = kept + 1; p <= 2; ++p) colours[p] = make_float4(0, 0, 0, 0);
}

// Store the colour of a splat without harmonics: one for all cameras.
__device__ inline void store_colour(const Gaussians<const float>& gaussians, int64_t i, const Splats<float>& out) {
  const float* sh = gaussians.sh + 3 * i;
  const glm::vec3 colour = glm::max(sh_colour<float>(0, sh, glm::vec3(0, 0, 1), glm::vec3(0)), glm::vec3(0));
  reinterpret_cast<float4*>(out.colours)[i] = make_float4(colour.x, colour.y, colour.z, 0);
}

// Set the projected mean from arithmetic in double. On a panel of thousands of pixels the last digits of a float cost
// small splats a dB. Return what rounding took from u0 and v0.
__device__ inline float2 place_mean(const Camera<double>& rig, const glm::vec3& mean, Splat<float>& splat) {
  const glm::dvec3 t = rig.rotation * glm::dvec3(mean) + rig.translation;
  const double iz = 1 / t.z, u = rig.fx * t.x * iz + rig.cx, v = rig.fy * t.y * iz + rig.cy;
  splat.u0 = float(u), splat.v0 = float(v), splat.du = float(rig.sweep * rig.fx * (rig.inverse_zero_depth - iz));
  auto rest = [](double exact, float rounded) {
    const float r = float(exact - double(rounded));
    return fabsf(r) < 1 ? r : 0.f;  // it is larger only far away from the panel
  };
  return make_float2(rest(u, splat.u0), rest(v, splat.v0));
}

// Project, cull and store splat i, and return it; reach_y < 0 says that it is not drawn. If `depths` is not null, the
// depth goes there. Its place in the splat then holds the rounding errors of u0 and v0, see whole_splat_about().
// watch(splat, circle, amplitudes) is told of every colour of an order above 2.
template <int Order, bool kCompensated, class Watch>
__device__ Splat<float> store_splat(const Gaussians<const float>& gaussians, const RoundedRig& rigs, int64_t width_px,
                                    int64_t height_px, const BasisTable& basis, const ColourLimits& limits, float cut,
                                    bool by_patches, float least_light, int64_t i, const Splats<float>& out,
                                    uint32_t* depths, unsigned* error, const Watch& watch) {
  const Camera<float>& rig = rigs.rounded;
  const Shape<float> shape = load_shape<float>(gaussians, i);
  Splat<float> splat;
  if constexpr (kCompensated)
    splat = compensated_splat(rigs.exact, shape, out.compensations[i]);
  else
    splat = Projection<float>(rig, shape).splat(rig, shape.opacity);
  const float2 rest = splat.reach_y >= 0 ? place_mean(rigs.exact, shape.mean, splat) : make_float2(0, 0);

  // Prune and cull
  const bool pruned = least_light > 0 && alpha_integral(splat) < least_light;
  if (cut > float(kLog2MinAlpha)) raise_cut(splat, cut, by_patches);
  cull_outside(splat, width_px, height_px);
  if (pruned && splat.reach_y >= 0) splat.reach_y = kPruned;

  // Store it, and if it is drawn its colours
  Splat<float> stored = splat;
  if (depths) depths[i] = __float_as_uint(splat.depth), stored.depth = packed(rest.x, rest.y);
  write_splat(stored, out.splats + i);
  if (out.orders) out.orders[i] = 0;
  if (splat.reach_y < 0) return splat;
  if constexpr (Order == 0)
    store_colour(gaussians, i, out);
  else
    store_colours<Order>(gaussians, shape.mean, rigs, basis, limits, i, out, error,
                         [&](const auto& circle, const auto& amplitudes) { watch(splat, circle, amplitudes); });
  return splat;
}

// Call run(order, compensated) with the order of the colours, and whether opacities are compensated, as compile-time
// constants.
template <class Run>
void with_order(int order, bool compensated, const Run& run) {
  auto with = [&](auto fixed) {
    compensated ? run(fixed, std::bool_constant<true>()) : run(fixed, std::bool_constant<false>());
  };
  switch (order) {
    case 0:
      return with(std::integral_constant<int, 0>());
    case 2:
      return with(std::integral_constant<int, 2>());
    case 4:
      return with(std::integral_constant<int, 4>());
    case 8:
      return with(std::integral_constant<int, 8>());
  }
  throw Error("colour order on CUDA must be 0, 2, 4 or 8, not " + std::to_string(order));
}

}  // namespace lfgs::cuda
