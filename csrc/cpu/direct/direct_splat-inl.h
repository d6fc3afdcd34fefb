// The colour and the footprint of a splat at the samples of a tile. There are several footprints: the exact one, and
// cheaper ones for splats where their error is small. with_footprint chooses the cheapest that every quality allows.

#if defined(LFGS_CPU_DIRECT_SPLAT_INL_H_) == defined(HWY_TARGET_TOGGLE)
#ifdef LFGS_CPU_DIRECT_SPLAT_INL_H_
#undef LFGS_CPU_DIRECT_SPLAT_INL_H_
#else
#define LFGS_CPU_DIRECT_SPLAT_INL_H_
#endif

#include <cmath>

#include "cpu/direct/direct_tile-inl.h"
#include "cpu/direct/direct_job.h"
#include "hwy/highway.h"
#include "math/blend-inl.h"
#include "math/colour_circle.h"
#include "math/quality.h"

HWY_BEFORE_NAMESPACE();
namespace lfgs {
namespace HWY_NAMESPACE {

constexpr double kMostApproximateError =
    0.005;  // of S^(-1/2) in approximate footprints, relative; others: kMostRootError

// A splat's colour: its polynomial, [order + 1, kColourStride], or its terms on a circle, see math/colour_circle.h.
template <class T>
const T* colours(const Splats<T>& splats, int32_t id) {
  return splats.colours + int64_t(id) * (splats.colour_order + 1) * kColourStride;
}

// The angles at which the cameras of samples see a splat whose colour is on a circle, see math/colour_circle.h.
template <class D>
struct CirclePoints {
  using V = hn::Vec<D>;
  V t, h;

  HWY_INLINE CirclePoints(D d, const hn::TFromD<D>* colour, V s) {
    const V distance = hn::Set(d, colour[kDistanceTerm * kColourStride + 3]);
    const V u = hn::Sub(s, hn::Set(d, colour[kPlaceTerm * kColourStride + 3]));
    const V r = hn::Sqrt(hn::MulAdd(u, u, hn::Mul(distance, distance)));
    t = hn::Div(u, r), h = hn::Div(distance, r);
  }
  // The colour, before it is clamped at zero.
  HWY_INLINE V colour(D d, const hn::TFromD<D>* colour, hn::Vec<hn::RebindToSigned<D>> channel) const {
    auto term = [&](int m) { return Lookup(d, colour + m * kColourStride, channel); };
    const V even = hn::MulAdd(hn::MulAdd(hn::MulAdd(term(3), t, term(2)), t, term(1)), t, term(0));
    return hn::MulAdd(hn::MulAdd(hn::MulAdd(term(6), t, term(5)), t, term(4)), h, even);
  }
  // Its derivative by the angle.
  HWY_INLINE V slope(D d, const hn::TFromD<D>* colour, hn::Vec<hn::RebindToSigned<D>> channel) const {
    auto term = [&](int m) { return Lookup(d, colour + m * kColourStride, channel); };
    auto times = [&](double k, V v) { return hn::Mul(hn::Set(d, hn::TFromD<D>(k)), v); };
    const V of_t = hn::MulAdd(hn::MulAdd(times(3, term(3)), t, times(2, term(2))), t, term(1));
    const V of_h = hn::MulAdd(hn::MulAdd(times(2, term(6)), t, term(5)), h, of_t);
    const V odd = hn::MulAdd(hn::MulAdd(term(6), t, term(5)), t, term(4));
    return hn::NegMulAdd(t, odd, hn::Mul(h, of_h));
  }
};

// The colour of a splat at the samples' offsets. kOrder is its order where that is known at compile time, or -1: then
// it is `order`.
template <int kOrder, class D>
HWY_INLINE hn::Vec<D> ColourAt(D d, const hn::TFromD<D>* colour, int order, hn::Vec<hn::RebindToSigned<D>> channel,
                               hn::Vec<D> s) {
  if constexpr (kOrder == 0) return Lookup(d, colour, channel);
  if constexpr (kOrder < 0)
    if (HWY_UNLIKELY(order == kCircleOrder))
      return hn::Max(CirclePoints<D>(d, colour, s).colour(d, colour, channel), hn::Zero(d));
  const int n = kOrder < 0 ? order : kOrder;
  auto c = Lookup(d, colour + n * kColourStride, channel);
  for (int p = n - 1; p >= 0; --p) c = hn::MulAdd(c, s, Lookup(d, colour + p * kColourStride, channel));
  return hn::Max(c, hn::Zero(d));
}

// The distance px - m(s) of samples from the middle of the splat in their row. Rows: RowTerms or RowVectors.
template <class T, class Rows>
HWY_INLINE hn::Vec<Tag<T>> DistanceX(hn::Vec<Tag<T>> x, hn::Vec<Tag<T>> s, const Rows& rows) {
  const Tag<T> d;
  return hn::NegMulAdd(s, Term(d, rows.M1), hn::Sub(x, Term(d, rows.M0)));
}

// alpha = 2^power of a splat that is never so opaque that alpha must be limited, zero where power is below the cut.
template <class D>
HWY_INLINE hn::Vec<D> FaintAlpha(D d, hn::Vec<D> power, hn::Vec<D> cut) {
  return hn::IfThenElseZero(hn::Ge(power, cut), Exp2<4>(d, power));
}

// The footprint by the formula of math/projection.h, right for every splat without compensation.
template <class T>
struct ExactFootprint {
  using D = Tag<T>;
  using V = hn::Vec<D>;
  V S0, S1, S2, cut;

  HWY_INLINE ExactFootprint(const Splat<T>& s, T log2_cut) {
    const D d;
    S0 = hn::Set(d, s.S0), S1 = hn::Set(d, s.S1), S2 = hn::Set(d, s.S2), cut = hn::Set(d, log2_cut);
  }
  // 1 / S(s)
  HWY_INLINE V inverse(V s) const {
    const D d;
    return Reciprocal(d, hn::MulAdd(hn::MulAdd(s, S2, S1), s, S0));
  }
  // Return log2 of opacity * weight; also set dx = px - m(s) and inverse_S = 1 / S(s).
  template <class Rows>
  HWY_INLINE V power(V x, V s, const Rows& rows, V& dx, V& inverse_S) const {
    const D d;
    dx = DistanceX<T>(x, s, rows);
    inverse_S = inverse(s);
    return hn::NegMulAdd(hn::Mul(dx, dx), inverse_S, Term(d, rows.A));
  }
  template <class Rows>
  HWY_INLINE V power(V x, V s, const Rows& rows) const {
    V dx, inverse_S;
    return power(x, s, rows, dx, inverse_S);
  }
  // Return alpha of a power at the offset s.
  HWY_INLINE V alpha(V power, V) const { return Alpha(D(), power, cut); }
};

// The compensation sqrt(D(s) / S(s)) of a splat at its samples, see math/compensation.h.
template <class T>
struct CompensationFactor {
  using D = Tag<T>;
  using V = hn::Vec<D>;
  V D0, D1, D2;

  HWY_INLINE explicit CompensationFactor(const Compensation<T>& c) {
    const D d;
    D0 = hn::Set(d, c.D0), D1 = hn::Set(d, c.D1), D2 = hn::Set(d, c.D2);
  }
  // D(s), which is S(s) without the blur.
  HWY_INLINE V unfiltered(V s) const { return hn::MulAdd(hn::MulAdd(s, D2, D1), s, D0); }
  HWY_INLINE V at(V s, V inverse_S) const {
    const D d;
    return hn::Sqrt(hn::Max(hn::Mul(unfiltered(s), inverse_S), hn::Zero(d)));  // rounding may take it below zero
  }
};

// alpha = min(0.99, factor 2^power), zero where it is below least = 2^cut.
template <class D>
HWY_INLINE hn::Vec<D> CompensatedAlpha(D d, hn::Vec<D> power, hn::Vec<D> factor, hn::Vec<D> cut, hn::Vec<D> least) {
  const auto alpha = hn::Mul(hn::IfThenElseZero(hn::Ge(power, cut), Exp2(d, power)), factor);
  return hn::IfThenElseZero(hn::Ge(alpha, least), hn::Min(alpha, hn::Set(d, hn::TFromD<D>(kMaxAlpha))));
}

// The same for a splat that is never so opaque that alpha must be limited.
template <class T>
struct FaintFootprint : ExactFootprint<T> {
  using V = typename ExactFootprint<T>::V;

  HWY_INLINE FaintFootprint(const Splat<T>& s, T log2_cut) : ExactFootprint<T>(s, log2_cut) {}
  static bool fits(const Splat<T>& s) { return s.log2_opacity <= T(kLog2MaxAlpha); }
  HWY_INLINE V alpha(V power, V) const { return FaintAlpha(Tag<T>(), power, this->cut); }
};

// The exact footprint of a compensated splat.
template <class T>
struct CompensatedFootprint {
  using D = Tag<T>;
  using V = hn::Vec<D>;
  ExactFootprint<T> exact;
  CompensationFactor<T> factor;
  V least;

  HWY_INLINE CompensatedFootprint(const Splat<T>& s, const Compensation<T>& c, T log2_cut)
      : exact(s, log2_cut), factor(c), least(hn::Set(D(), std::exp2(log2_cut))) {}
  template <class Rows>
  HWY_INLINE V power(V x, V s, const Rows& rows) const {
    return exact.power(x, s, rows);
  }
  HWY_INLINE V alpha(V power, V s) const {
    return CompensatedAlpha(D(), power, factor.at(s, exact.inverse(s)), exact.cut, least);
  }
};

// The footprint of a faint splat whose S^(-1/2) is near enough to a parabola over the rig.
template <class T>
struct PlainFootprint {
  using D = Tag<T>;
  using V = hn::Vec<D>;
  V r0, r1, r2, cut;

  HWY_INLINE PlainFootprint(const InverseRoot<T>& root, T log2_cut) {
    const D d;
    r0 = hn::Set(d, root.r0), r1 = hn::Set(d, root.r1), r2 = hn::Set(d, root.r2), cut = hn::Set(d, log2_cut);
  }
  static bool fits(const Splat<T>& s, const InverseRoot<T>& root) {
    return root.error < T(kMostRootError) && FaintFootprint<T>::fits(s);
  }
  template <class Rows>
  HWY_INLINE V power(V x, V s, const Rows& rows) const {
    const D d;
    const V e = hn::Mul(DistanceX<T>(x, s, rows), hn::MulAdd(hn::MulAdd(s, r2, r1), s, r0));
    return hn::NegMulAdd(e, e, Term(d, rows.A));
  }
  HWY_INLINE V alpha(V power, V) const { return FaintAlpha(D(), power, cut); }
};

// The footprint in few operations, for approximate evaluation. S^(-1/2) is taken as constant over the rig (kEven) or as
// a straight line in s. 2^power is approximated by y^16, y = (gain (power + level))^2 + rest. Its relative error is
// below 0.9 % for alpha from 1/255 to 1, and below 0.35 % from 0.05 on. Unlike Exp2, squaring needs no split of the
// exponent, and few constants. RowTerms have gain and level in them already, see units().
template <bool kEven>
class ApproximateFootprint {
 public:
  using T = float;
  using D = Tag<T>;
  using V = hn::Vec<D>;

  ApproximateFootprint(const InverseRoot<T>& r, T log2_cut)
      : root_(std::sqrt(kGain) * (r.r0 + T(0.5) * r.r2)),
        lean_(std::sqrt(kGain) * r.r1),
        cut_(kGain * (log2_cut + kLevel)) {}
  static bool fits(const InverseRoot<T>& r) {
    const T off = T(0.5) * std::abs(r.r2) + (kEven ? std::abs(r.r1) : T(0));
    return r.error + off / std::abs(r.r0) < T(kMostApproximateError);  // where the error is 1, r0 may be any number
  }
  RowUnits<T> units() const { return {kGain, kLevel, kEven ? -root_ : T(1)}; }

  template <class Rows>
  HWY_INLINE V weight(V x, V s, const Rows& rows, V transmittance) const {
    const D d;
    V e;
    if constexpr (kEven)
      e = hn::MulAdd(x, hn::Set(d, root_), hn::MulAdd(s, Term(d, rows.M1), Term(d, rows.M0)));
    else
      e = hn::Mul(DistanceX<T>(x, s, rows), hn::MulAdd(s, hn::Set(d, lean_), hn::Set(d, root_)));
    const V power = hn::NegMulAdd(e, e, Term(d, rows.A));
    V y = hn::MulAdd(power, power, hn::Set(d, kRest));
    for (int k = 0; k < 4; ++k) y = hn::Mul(y, y);
    y = hn::Min(y, hn::Set(d, T(kMaxAlpha)));
    return hn::IfThenElseZero(hn::Ge(power, hn::Set(d, cut_)), hn::Mul(y, transmittance));
  }

 private:
  static constexpr T kGain = 0.0284034f, kLevel = 26.6557f, kRest = 0.4266943f;
  T root_, lean_, cut_;
};

// Call visit with the cheapest footprint that is near enough for a splat; compensation: the splat's, or null.
template <class T, class Visit>
void with_footprint(const TileSplat<T>& tile_splat, const Compensation<T>* compensation, const Quality& quality,
                    const Visit& visit) {
  const Splat<T>& splat = tile_splat.splat;
  const T cut = T(quality.sample_cut());
  if (HWY_UNLIKELY(compensation != nullptr)) return visit(CompensatedFootprint<T>(splat, *compensation, cut));
  if constexpr (sizeof(T) == 4) {
    const InverseRoot<T>& root = tile_splat.root;
    if (PlainFootprint<T>::fits(splat, root)) return visit(PlainFootprint<T>(root, cut));
    if (FaintFootprint<T>::fits(splat)) return visit(FaintFootprint<T>(splat, cut));
  }
  visit(ExactFootprint<T>(splat, cut));
}

}  // namespace HWY_NAMESPACE
}  // namespace lfgs
HWY_AFTER_NAMESPACE();

#endif  // LFGS_CPU_DIRECT_SPLAT_INL_H_
