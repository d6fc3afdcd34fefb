// Front-to-back blending of splats, and its backward pass. A sample lets T_i = (1 - alpha_1) ... (1 - alpha_(i-1)) of
// the light through to splat i, which adds its weight w_i = alpha_i T_i. v_i is the derivative of the loss by that
// weight.
//
//   dL/dalpha_i = T_i v_i - (total - prefix_i) / (1 - alpha_i).
//
// total is the sum of w v over all splats and the background, prefix_i the sum up to and with splat i. The total
// follows from the image, so the backward pass walks front to back as well. The formula has a twin in
// cuda/common/blend.cuh, because one copy would cost speed or bits. Here it is masks and fused operations of Highway on
// a vector. There it is branches on one float, and nvcc chooses what to fuse.

#if defined(LFGS_MATH_OVER_INL_H_) == defined(HWY_TARGET_TOGGLE)
#ifdef LFGS_MATH_OVER_INL_H_
#undef LFGS_MATH_OVER_INL_H_
#else
#define LFGS_MATH_OVER_INL_H_
#endif

#include "hwy/highway.h"
#include "math/blend-inl.h"
#include "math/constants.h"
#include "math/gradient_sums.h"
#include "math/projection.h"

HWY_BEFORE_NAMESPACE();
namespace lfgs {
namespace HWY_NAMESPACE {

// Blend one splat over a vector of samples: `weight` is its part of the light of each, which their transmittances lose.
// A sample whose transmittance would fall too low ends here: the light that it still lets through goes to `rest` for
// the background. Return whether a sample ended and with it the last of the vector.
template <class D>
HWY_INLINE bool Over(D d, hn::Vec<D> alpha, hn::TFromD<D>* HWY_RESTRICT transmittance, hn::TFromD<D>* HWY_RESTRICT rest,
                     hn::Vec<D>& weight) {
  const auto before = hn::Load(d, transmittance);
  weight = hn::Mul(alpha, before);
  auto after = hn::Sub(before, weight);
  bool done = false;
  const auto stop = hn::Lt(after, hn::Set(d, hn::TFromD<D>(kMinTransmittance)));
  if (HWY_UNLIKELY(!hn::AllFalse(d, stop))) {
    hn::BlendedStore(before, hn::And(stop, hn::Gt(before, hn::Zero(d))), d, rest);
    weight = hn::IfThenZeroElse(stop, weight);
    after = hn::IfThenZeroElse(stop, after);
    done = hn::AllTrue(d, hn::Eq(after, hn::Zero(d)));
  }
  hn::Store(after, d, transmittance);
  return done;
}

// The same splat on the way back: the transmittances lose what they lost to Over, and where a sample ended before it
// alpha becomes zero. Return where; `before` receives the transmittances before this splat. Over subtracts the weight
// that it needs anyway, here one operation does for both: so the last digit of a transmittance may differ.
template <class D>
HWY_INLINE hn::Mask<D> OverAgain(D d, hn::Vec<D>& alpha, hn::TFromD<D>* HWY_RESTRICT transmittance,
                                 hn::Vec<D>& before) {
  before = hn::Load(d, transmittance);
  const auto after = hn::NegMulAdd(alpha, before, before);
  const auto stop = hn::Lt(after, hn::Set(d, hn::TFromD<D>(kMinTransmittance)));
  hn::Store(hn::IfThenZeroElse(stop, after), d, transmittance);
  alpha = hn::IfThenZeroElse(stop, alpha);
  return stop;
}

// Return dL/dalpha, and add this splat to `prefix`. kEstimate: divide by an estimate and a Newton step, as
// ordinary images do; panels divide exactly. The choice decides the last digits of the gradients.
template <bool kEstimate, class D>
HWY_INLINE hn::Vec<D> OverBackward(D d, hn::Vec<D> alpha, hn::Vec<D> before, hn::Vec<D> weight, hn::Vec<D> v,
                                   const hn::TFromD<D>* HWY_RESTRICT total, hn::TFromD<D>* HWY_RESTRICT prefix) {
  const auto so_far = hn::MulAdd(weight, v, hn::Load(d, prefix));
  hn::Store(so_far, d, prefix);
  const auto rest = hn::Sub(hn::Load(d, total), so_far), through = hn::Sub(hn::Set(d, hn::TFromD<D>(1)), alpha);
  const auto later = kEstimate ? hn::Mul(rest, Reciprocal(d, through)) : hn::Div(rest, through);
  return hn::MulSub(before, v, later);
}

// Return the gradient of the exponent, log2 alpha, from the gradient of alpha. It is zero unless `free`: where alpha is
// cut or limited it does not follow the exponent.
template <class D>
HWY_INLINE hn::Vec<D> ExponentBackward(D d, hn::Vec<D> g_alpha, hn::Vec<D> alpha, hn::Mask<D> free) {
  return hn::IfThenElseZero(free, hn::Mul(hn::Mul(g_alpha, alpha), hn::Set(d, hn::TFromD<D>(kLn2))));
}

// Gradient sums of one splat over the samples it touches, a vector each; see FootprintSum for their meaning.
template <class D>
struct SplatSums {
  using V = hn::Vec<D>;
  using T = hn::TFromD<D>;
  V power, power_dy, power_dy2;  // gradients of the exponent, times 1, dy and dy^2
  V x, x_s, x_dy, x_s_dy;        // gradients of dx = px - m
  V S, S_s, S_s2;                // gradients of S(s)

  explicit HWY_INLINE SplatSums(D d) {
    power = power_dy = power_dy2 = x = x_s = x_dy = x_s_dy = S = S_s = S_s2 = hn::Zero(d);
  }

  // One camera: g is the gradient of power = log2 o - tau dy^2 - dx^2 / S, e = dx / S.
  HWY_INLINE void Add(V g, V dy, V e) {
    AddRows(g, dy);
    const V ge = hn::Mul(g, e);
    x = hn::Sub(x, hn::Add(ge, ge));
    x_dy = hn::NegMulAdd(hn::Add(ge, ge), dy, x_dy);
    S = hn::MulAdd(ge, e, S);
  }
  // A rig: the same at the sample's offset s.
  HWY_INLINE void Add(V g, V dy, V e, V s) {
    AddRows(g, dy);
    const V ge = hn::Mul(g, e), gx = hn::Neg(hn::Add(ge, ge)), gx_s = hn::Mul(gx, s);
    x = hn::Add(x, gx);
    x_s = hn::Add(x_s, gx_s);
    x_dy = hn::MulAdd(gx, dy, x_dy);
    x_s_dy = hn::MulAdd(gx_s, dy, x_s_dy);
    const V gS = hn::Mul(ge, e), gS_s = hn::Mul(gS, s);
    S = hn::Add(S, gS);
    S_s = hn::Add(S_s, gS_s);
    S_s2 = hn::MulAdd(gS_s, s, S_s2);
  }

  // Add to `out` the splat's gradient, summed over the lanes.
  HWY_INLINE void Reduce(D d, const Splat<T>& s, Splat<T>& out) const {
    auto sum = [&](V v) { return hn::GetLane(hn::SumOfLanes(d, v)); };
    T sums[kDirectFootprintSums];
    sums[kPowerSum] = sum(power), sums[kPowerDySum] = sum(power_dy), sums[kPowerDy2Sum] = sum(power_dy2);
    sums[kXSum] = sum(x), sums[kXsSum] = sum(x_s), sums[kXDySum] = sum(x_dy), sums[kXsDySum] = sum(x_s_dy);
    sums[kSSum] = sum(S), sums[kSsSum] = sum(S_s), sums[kSs2Sum] = sum(S_s2);
    const Splat<T> g = direct_gradient(s, sums);
    out.u0 += g.u0, out.du += g.du, out.v0 += g.v0, out.log2_opacity += g.log2_opacity;
    out.S0 += g.S0, out.S1 += g.S1, out.S2 += g.S2;
    out.tau += g.tau, out.c0 += g.c0, out.c1 += g.c1;
  }

 private:
  HWY_INLINE void AddRows(V g, V dy) {
    power = hn::Add(power, g);
    const V g_dy = hn::Mul(g, dy);
    power_dy = hn::Add(power_dy, g_dy);
    power_dy2 = hn::MulAdd(g_dy, dy, power_dy2);
  }
};

}  // namespace HWY_NAMESPACE
}  // namespace lfgs
HWY_AFTER_NAMESPACE();

#endif  // LFGS_MATH_OVER_INL_H_
