// The colour of a Gaussian as seen from everywhere along a rig, exactly. Cameras on a line see a mean from directions
// on a great circle. On it, harmonics to degree 3 are a trigonometric polynomial of degree 3. Its angle is measured
// from the foot of the perpendicular from the mean to the line. `place` is the foot's s, and `distance` the mean's
// distance from the line, both in units of s.
//   t = sin = (s - place) / r,   h = cos = distance / r,   r^2 = (s - place)^2 + distance^2,
//   colour = c0 + c1 t + c2 t^2 + c3 t^3 + h (c4 + c5 t + c6 t^2).
// Near the cameras it replaces a colour polynomial (math/colour_polynomial.h), which would err too much there.
// circle_tail() bounds the error.
#pragma once

#include <glm/glm.hpp>

#include <cmath>

#include "base/config.h"
#include "math/constants.h"
#include "math/harmonics.h"
#include "scene/camera.h"

namespace lfgs {

constexpr int kCircleOrder = -1;  // stored as the order of a polynomial
constexpr int kCircleTerms = 7;   // c0 to c6, stored like the powers of s of a polynomial
// A colour on a circle, and its gradient, take as many numbers as a polynomial of this order.
constexpr int kLeastCircleOrder = 7;
// The terms whose fourth number, behind the three channels, is `place` and `distance`.
constexpr int kPlaceTerm = 1, kDistanceTerm = 2;
// In the gradient, behind the terms: the sums over samples of gradient times d colour / d angle, times h^2 and times
// t h. The gradients of place and distance are minus these sums, divided by the distance.
constexpr int kAlongSum = 3 * kCircleTerms, kAcrossSum = kAlongSum + 1;
static_assert(3 * (kLeastCircleOrder + 1) > kAcrossSum);

// How many terms a colour has whose order this is.
LFGS_HD int colour_terms(int order) { return order < 0 ? kCircleTerms : order + 1; }

// The circle of directions in which a rig sees a mean, in world axes.
template <class R>
struct ColourCircle {
  glm::vec<3, R> along, foot;  // unit vectors: along the rig, and from the foot of the perpendicular to the mean
  R place, distance;           // in units of s
  R unit;                      // length of such a unit

  template <class S>
  LFGS_HD explicit ColourCircle(const ColourCircle<S>& other)
      : along(other.along), foot(other.foot), place(R(other.place)), distance(R(other.distance)), unit(R(other.unit)) {}
  LFGS_HD ColourCircle(const Camera<R>& rig, const glm::vec<3, R>& mean) {
    const glm::vec<3, R> right = rig.right(), to_mean = mean - rig.centre();
    const R length = glm::length(right);
    along = right / length, unit = rig.sweep * length;
    const R x = glm::dot(to_mean, along);
    const glm::vec<3, R> across = to_mean - x * along;
    const R away = glm::length(across);
    foot = away > 0 ? across / away : glm::vec<3, R>(0, 0, 1);
    place = x / unit, distance = away / unit;
  }

  // The gradient of the mean, from the gradients of foot, place and distance. That of the rig's centre is minus this.
  LFGS_HD glm::vec<3, R> backward(const glm::vec<3, R>& g_foot, R g_place, R g_distance) const {
    const glm::vec<3, R> turned = g_foot - glm::dot(g_foot, foot) * foot - glm::dot(g_foot, along) * along;
    return (turned / distance + g_place * along + g_distance * foot) / unit;
  }
};

// The gradients of what a colour reads of a circle. Those of along and foot count as far as both stay unit vectors at a
// right angle.
template <class R>
struct CircleGradient {
  glm::vec<3, R> along, foot;
  R place, distance;
};

// Sine, cosine and weights of node j of kCircleTerms nodes round the circle. A term of a colour is the sum over the
// nodes of weight times the colour there.
template <class R>
struct CircleNode {
  R sine, cosine, weights[kCircleTerms];

  LFGS_HD explicit CircleNode(int j) {
    constexpr double kSines[] = {0, 0.7818314824680298, 0.9749279121818236, 0.4338837391175581};
    constexpr double kCosines[] = {1, 0.6234898018587336, -0.2225209339563144, -0.9009688679024191};
    const int mirrored = j <= kCircleTerms / 2 ? j : kCircleTerms - j;
    sine = R(j == mirrored ? kSines[mirrored] : -kSines[mirrored]), cosine = R(kCosines[mirrored]);
    // Fourier coefficients, and sines and cosines of multiples as polynomials in t and h
    const R c2 = 1 - 2 * sine * sine, c3 = cosine * (1 - 4 * sine * sine), s2 = 2 * sine * cosine;
    const R s3 = sine * (3 - 4 * sine * sine), each = R(2) / kCircleTerms;
    weights[0] = each * (R(0.5) + c2), weights[1] = each * (sine + 3 * s3), weights[2] = -2 * each * c2;
    weights[3] = -4 * each * s3, weights[4] = each * (cosine + c3), weights[5] = 2 * each * s2;
    weights[6] = -4 * each * c3;
  }
  LFGS_HD glm::vec<3, R> direction(const ColourCircle<R>& circle) const {
    return cosine * circle.foot - sine * circle.along;
  }
};

// The terms of a colour, [kCircleTerms].
template <class R, class T>
LFGS_HD void circle_colour(int degree, const T* sh, const ColourCircle<R>& circle, glm::vec<3, R>* terms) {
  for (int m = 0; m < kCircleTerms; ++m) terms[m] = glm::vec<3, R>(0);
  LFGS_NO_UNROLL
  for (int j = 0; j < kCircleTerms; ++j) {
    const CircleNode<R> node(j);
    const glm::vec<3, R> value = sh_colour_towards(degree, sh, node.direction(circle));
    LFGS_UNROLL
    for (int m = 0; m < kCircleTerms; ++m) terms[m] += node.weights[m] * value;
  }
}

// Its backward pass, from the sums of samples as kAlongSum says: adds to g_sh, and returns the gradient of the mean.
// Write the gradient of the circle to `g_circle` unless it is null.
template <class R, class T, class G, class S>
LFGS_HD glm::vec<3, R> circle_colour_backward(int degree, const T* sh, const ColourCircle<R>& circle, const S* sums,
                                              G* g_sh, CircleGradient<R>* g_circle = nullptr) {
  glm::vec<3, R> g_foot(0), g_along(0);
  LFGS_NO_UNROLL
  for (int j = 0; j < kCircleTerms; ++j) {
    const CircleNode<R> node(j);
    glm::vec<3, R> g_value(0);
    for (int m = 0; m < kCircleTerms; ++m)
      for (int c = 0; c < 3; ++c) g_value[c] += node.weights[m] * R(sums[3 * m + c]);
    const glm::vec<3, R> g_direction = sh_colour_towards_backward(degree, sh, node.direction(circle), g_value, g_sh);
    g_foot += node.cosine * g_direction;
    if (g_circle) g_along -= node.sine * g_direction;
  }
  const R g_place = -R(sums[kAlongSum]) / circle.distance, g_distance = -R(sums[kAcrossSum]) / circle.distance;
  if (g_circle) *g_circle = {g_along, g_foot, g_place, g_distance};
  return circle.backward(g_foot, g_place, g_distance);
}

// The gradients of a rig's x-axis, Camera::right(), and of its sweep, from that of the circle of a mean.
template <class R>
struct LineGradient {
  glm::vec<3, R> right;
  R sweep;

  LFGS_HD LineGradient(const Camera<R>& rig, const ColourCircle<R>& circle, const CircleGradient<R>& g) {
    // A turn of `along` by d moves the foot of the perpendicular: x = mean . along, across = mean - x along
    const R length = glm::length(rig.right()), x = circle.place * circle.unit, away = circle.distance * circle.unit;
    const glm::vec<3, R> to_mean = x * circle.along + away * circle.foot;
    const R g_x = g.place / circle.unit, g_away = g.distance / circle.unit;
    const R foot_foot = glm::dot(g.foot, circle.foot), foot_along = glm::dot(g.foot, circle.along);
    glm::vec<3, R> g_along = g.along + g_x * to_mean - g_away * x * circle.foot;
    g_along += (x * (foot_foot * circle.foot - g.foot) - foot_along * to_mean) / away;
    const R g_unit = -(g.place * circle.place + g.distance * circle.distance) / circle.unit;
    right = (g_along - glm::dot(g_along, circle.along) * circle.along) / length + g_unit * rig.sweep * circle.along;
    sweep = g_unit * length;
  }
};

// t and h of the camera at s.
template <class R>
struct CirclePoint {
  R t, h;

  LFGS_HD CirclePoint(R place, R distance, R s) {
    const R u = s - place, inverse = 1 / std::sqrt(u * u + distance * distance);
    t = u * inverse, h = distance * inverse;
  }
  // A channel's colour, before it is clamped at zero; term(m) is its number in term m.
  template <class Term>
  LFGS_HD R colour(const Term& term) const {
    return term(0) + t * (term(1) + t * (term(2) + t * term(3))) + h * (term(4) + t * (term(5) + t * term(6)));
  }
  // Its derivative by the angle.
  template <class Term>
  LFGS_HD R slope(const Term& term) const {
    return h * (term(1) + t * (2 * term(2) + 3 * t * term(3)) + h * (term(5) + 2 * t * term(6))) -
           t * (term(4) + t * (term(5) + t * term(6)));
  }
};

// Bounds of the amplitudes of the circle's first three harmonics, the largest over the channels. Rotate the circle to
// the equator. A band of degree l keeps its norm, and only its orders +-k add to harmonic k there.
template <class R, class T>
LFGS_HD glm::vec<3, R> circle_amplitudes(int degree, const T* sh) {
  glm::vec<3, R> most(0);
  for (int c = 0; c < 3; ++c) {
    R square[3] = {0, 0, 0};
    LFGS_UNROLL
    for (int k = 1; k < kMaxShCount; ++k)
      if (k < (degree + 1) * (degree + 1)) square[k < 4 ? 0 : k < 9 ? 1 : 2] += R(sh[3 * k + c]) * R(sh[3 * k + c]);
    const R third = std::sqrt(square[2]);
    most = glm::max(most, glm::vec<3, R>(R(0.48860252) * std::sqrt(square[0]) + R(0.45704580) * third,
                                         R(0.54627422) * std::sqrt(square[1]), R(0.59004360) * third));
  }
  return most;
}

// A bound, over s in -1..1, of the error of the polynomial that interpolates a colour on a circle at order + 1
// Chebyshev nodes. e^(i angle) is ((s - w*) / (s - w))^(1/2) but for a factor of size 1, where w = place + i distance.
// With s = (z + 1/z) / 2, w becomes a point of size rho. rho is the half axes' sum of the ellipse with foci -1 and 1
// through w (Trefethen, Approximation Theory and Approximation Practice, chapter 8). e^(i k angle) becomes the product
// G(z) G(1/z) of two series. G(z) = (1 - z v*)^(k/2) (1 - z v)^(-k/2) with |v| = 1 / rho. For k = 1, 2, 3, term by
// term, G is at most a series in x = z / rho. They are 2 (1 - x)^(-1/2) - 1, (1 + x) / (1 - x) and 1 + 3 x (1 -
// x)^(-3/2). Their coefficient m is at most 2 / sqrt(pi m), 2 and 6 sqrt(m / pi). So Chebyshev coefficient n of the
// colour is at most twice the amplitude times the sum over m of coefficients n + m and m. The error of interpolation is
// at most twice the sum of all coefficients beyond its order.
template <class R>
LFGS_HD R circle_tail(int order, const glm::vec<3, R>& amplitudes, R place, R distance) {
  auto away = [&](R focus) { return std::sqrt((place - focus) * (place - focus) + distance * distance); };
  const R half_axis = (away(R(1)) + away(R(-1))) / 2;
  const R root = std::sqrt(half_axis * half_axis - 1), rho = half_axis + root;
  if (!(root > 0)) return R(1e30);
  const R y = 1 / rho, x = y * y, left = 1 - x, n = R(order + 1);
  R power = 1;
  for (int k = 0; k <= order; ++k) power *= y;
  const R tail = power / (1 - y);  // the sum of y^m from n on
  const R s1 = R(1.1283792), s3 = R(3.3851376), per_root = 1 / std::sqrt(left);
  const R first = s1 / std::sqrt(n) * (1 + s1 * x / left);
  const R second = 2 * (1 + x) / left;
  const R third = s3 * std::sqrt(n) * (1 + y / (2 * n * (1 - y))) *
                  (1 + s3 * x * per_root / left * (1 + std::sqrt(1 + x) / (2 * n * left)));
  return 4 * tail * (amplitudes.x * first + amplitudes.y * second + amplitudes.z * third);
}

}  // namespace lfgs
