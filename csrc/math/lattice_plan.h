// The plan of a coarse lattice in (x, y, view) for a part of the panel. LatticeCurvature measures how fast the light
// field varies, from the splats that are seen there, and makes a LatticePlan. From view to view the picture moves by
// its disparity, so that a light field is smooth along the view only if x moves along. Between two planes,
// interpolation therefore follows x + shear s, where shear is the mean disparity of the visible splats.
#pragma once

#include <cmath>

#include "base/config.h"
#include "math/projection.h"

namespace lfgs {

// A part of the panel: the bounds of its sample centres, in pixels, and of the offsets that its samples show.
struct LatticePart {
  float x_low, x_high, y_low, y_high, s_low, s_high;
};

// The largest error of a lattice may be as large as the quality says; the root mean square must be so many times
// smaller. Where nodes were moved to lessen the errors at the middles, it must be smaller still, for elsewhere more
// error is left than there.
constexpr float kMeanFactor = 5, kMovedFactor = 8;
// The factor of the errors at the middles round a node by which it is moved. Linear interpolation of a curved field
// errs to one side. The error is x (1 - x) times the curvature in each direction, x the place in the cell. For three
// equal directions this is 3/4 in the middle of a cell. The average is 1/2, two thirds of that. A quarter of the root
// mean square is left.
constexpr float kNodeFactor = 2.f / 3;
constexpr float kMostFineness = 1.2f, kBackOff = 0.85f;  // largest steps, in standard deviations; margin of the next
LFGS_HD float first_fineness(float error) { return std::fmin(3.0f * std::sqrt(error), kMostFineness); }
// Lattices are tried on every kProbeRows-th row of tiles first. The rows beside one whose tiles rarely fit have no
// lattices.
constexpr int kProbeRows = 8;

// Limits by which an int can count nodes and middles, however fine a lattice is wanted: (30001 x 257 + 9999 x 256) x
// 128.
constexpr int kMostPlanes = 128, kMostRows = 256, kMostColumns = 10000;

// Nodes (x0 + i step_x, y0 + j step_y) on planes s0 + k step_s. The content of a node on one plane is seen up to
// `margin` nodes aside on the next. So rows have `margin` more nodes at both ends.
struct LatticeGrid {
  int across, down, planes, margin;
  float x0, y0, s0, step_x, step_y, step_s;

  LFGS_HD int per_plane() const { return across * down; }
  LFGS_HD int nodes() const { return per_plane() * planes; }
  // How many cells of a row may have samples.
  LFGS_HD int cells() const { return across - 1 - 2 * margin; }
};

// A lattice whose cells lean: a point at node i of plane k is at about node i + lean[k] of the next plane.
struct LatticePlan : LatticeGrid {
  float lean[kMostPlanes];

  // The middles of the cells in which samples of the part lie, as a plan of their own.
  LFGS_HD LatticePlan middles(const LatticePart& part) const {
    LatticePlan out = *this;
    out.x0 = part.x_low + step_x / 2, out.y0 = y0 + step_y / 2, out.s0 = s0 + step_s / 2;
    out.across = cells(), out.down = down - 1, out.planes = planes - 1;
    return out;
  }
};

// How fast the light field of a part varies: second derivatives of its splats' exponents, weighted by opacity. They are
// summed in bins of the offsets from which the splats are seen.
class LatticeCurvature {
 public:
  static constexpr int kBins = 16;
  // The part of a splat in the bins from first to last.
  struct Term {
    float weight, x, y, x_du, x_du2;
    int first, last;
  };
  // Opacities, their second derivatives along x and y, and those along x times disparity and its square.
  struct Sums {
    float weight = 0, x = 0, y = 0, x_du = 0, x_du2 = 0;
    LFGS_HD void add(const Term& t) { weight += t.weight, x += t.x, y += t.y, x_du += t.x_du, x_du2 += t.x_du2; }
    // The mean disparity, and the second derivative along the view if x follows it.
    LFGS_HD float shear() const { return x > 0 ? x_du / x : 0; }
    LFGS_HD float spread() const { return x_du2 - shear() * x_du; }
  };

  LFGS_HD explicit LatticeCurvature(const LatticePart& part)
      : part_(part),
        middle_((part.x_low + part.x_high) / 2),
        half_((part.x_high - part.x_low) / 2),
        bins_per_s_(part.s_high > part.s_low ? kBins / (part.s_high - part.s_low) : 0) {}

  // The part of a splat whose centre is at u from the part's origin.
  LFGS_HD Term term(const Splat<float>& s, float u) const {
    const float opacity = std::exp2(s.log2_opacity), inverse = opacity / s.S0;
    const float y = opacity * s.tau + s.c0 * s.c0 * inverse, x_du = inverse * s.du, x_du2 = x_du * s.du;

    // The bins of the offsets at which its sweep is over the part
    const float reach = half_ + std::sqrt(s.log2_opacity - float(kLog2MinAlpha)) * std::sqrt(s.S0);
    const float near = (middle_ - reach - u) / s.du, far = (middle_ + reach - u) / s.du;
    const float low = (std::fmin(near, far) - part_.s_low) * bins_per_s_;
    const float high = (std::fmax(near, far) - part_.s_low) * bins_per_s_;
    // A splat without disparity is seen from everywhere, for one seen from nowhere is not in the list
    const int first = low > 0 ? int(std::fmin(low, float(kBins))) : 0, last = high < kBins ? int(high) : kBins - 1;
    return {opacity, inverse, y, x_du, x_du2, first, last};
  }
  LFGS_HD void add(const Splat<float>& s, float u) {
    const Term t = term(s, u);
    for (int b = t.first; b <= t.last; ++b) bins_[b].add(t);
  }
  LFGS_HD void set(int bin, const Sums& sums) { bins_[bin] = sums; }

  // Sum over all bins.
  struct Totals {
    float weight = 0, x = 0, y = 0, spread = 0;
    LFGS_HD void add(const Sums& b) { weight += b.weight, x += b.x, y += b.y, spread += b.spread(); }
  };

  // Plan a lattice with steps of about `fineness` standard deviations of what is seen, and with no more than
  // most_planes planes.
  LFGS_HD void plan(float fineness, LatticePlan& out, int most_planes = kMostPlanes) const {
    Totals totals;
    for (const Sums& b : bins_) totals.add(b);
    lay(totals, fineness, most_planes, out);
    float margin = 0;
    for (int k = 0; k < out.planes; ++k) margin = std::fmax(margin, std::fabs(out.lean[k] = plane_lean(k, out)));
    widen(margin, out);
  }

  // The three parts of plan(), for kernels in which threads share the work. lay() sets rows, planes and steps,
  // plane_lean() returns the lean of a plane, and widen() sets the columns from the largest |lean|.
  LFGS_HD void lay(const Totals& of, float fineness, int most_planes, LatticeGrid& out) const {
    const float unit = of.weight > 0 ? fineness * std::sqrt(of.weight) : 1e20f;  // if nothing is seen, corners will do
    const int rows = steps(part_.y_high - part_.y_low, unit / std::sqrt(of.y), kMostRows);
    const int views = steps(part_.s_high - part_.s_low, unit / std::sqrt(std::fmax(of.spread, 1e-20f)), kMostPlanes);
    out.down = rows + 1, out.planes = views < most_planes ? views + 1 : most_planes;
    out.y0 = part_.y_low, out.s0 = part_.s_low;
    out.step_y = (part_.y_high - part_.y_low) / float(rows);
    out.step_s = (part_.s_high - part_.s_low) / float(out.planes - 1);
    if (!(out.step_y > 0)) out.step_y = 1;
    if (!(out.step_s > 0)) out.step_s = 1;
    out.step_x = std::fmin(unit / std::sqrt(of.x), 1e9f);
  }
  LFGS_HD float plane_lean(int plane, const LatticeGrid& out) const {
    if (plane + 1 >= out.planes) return 0;
    const float nodes = std::round(shear_at((float(plane) + 0.5f) / float(out.planes - 1)) * out.step_s / out.step_x);
    return std::fmin(std::fmax(nodes, float(-kMostColumns)), float(kMostColumns));
  }
  // A sample between two planes lies up to `lean` nodes aside on each.
  LFGS_HD void widen(float margin, LatticeGrid& out) const {
    out.margin = int(margin);
    out.across = steps(part_.x_high - part_.x_low, out.step_x, kMostColumns) + 1 + 2 * out.margin;
    out.x0 = part_.x_low - margin * out.step_x;
  }

  LFGS_HD const Sums& bin(int b) const { return bins_[b]; }

 private:
  LFGS_HD static int steps(float length, float step, int most) {
    const float n = std::ceil(length / step);
    return n >= 1 ? n < float(most) ? int(n) : most : 1;
  }

  // The mean disparity at a fraction of the offsets, from 0 for the lowest to 1 for the highest. It is linear between
  // the two neighbouring bins; a bin that sees nothing does not count.
  LFGS_HD float shear_at(float fraction) const {
    const float place = fraction * kBins - 0.5f;
    const int below = place > 0 ? int(place) : 0, above = below + 1 < kBins ? below + 1 : below;
    const Sums &a = bins_[below], &b = bins_[above];
    if (!(a.x > 0 && b.x > 0)) return a.x > 0 ? a.shear() : b.shear();
    const float part = std::fmin(std::fmax(place - float(below), 0.f), 1.f);
    return a.shear() + part * (b.shear() - a.shear());
  }

  LatticePart part_;
  float middle_, half_, bins_per_s_;
  Sums bins_[kBins];
};

}  // namespace lfgs
