// Arithmetic on one vector of samples: powers of two, looking colours up, alpha. All sensors share it. Highway includes
// it once for every instruction set. float runs on full vectors; double is the exact twin and runs on one lane, with
// the C library's exp2.

#if defined(LFGS_MATH_BLEND_INL_H_) == defined(HWY_TARGET_TOGGLE)
#ifdef LFGS_MATH_BLEND_INL_H_
#undef LFGS_MATH_BLEND_INL_H_
#else
#define LFGS_MATH_BLEND_INL_H_
#endif

#include <cmath>

#include "hwy/highway.h"
#include "math/constants.h"
#include "math/projection.h"

HWY_BEFORE_NAMESPACE();
namespace lfgs {
namespace HWY_NAMESPACE {
namespace hn = hwy::HWY_NAMESPACE;

// The tag of each precision: as many float lanes as the machine has, 16 at most; one double lane.
template <class T>
struct TagOf;
template <>
struct TagOf<float> {
  using type = hn::CappedTag<float, 16>;
};
template <>
struct TagOf<double> {
  using type = hn::CappedTag<double, 1>;
};
template <class T>
using Tag = typename TagOf<T>::type;

// 2^x for x in [-126, 1]; below that the result may be anything. float: relative error < 2e-7; where 3e-6 will do,
// kDegree 4 saves one of 10 operations.
template <int kDegree = 5, class D>
HWY_INLINE hn::Vec<D> Exp2(D d, hn::Vec<D> x) {
  if constexpr (sizeof(hn::TFromD<D>) == 8) {
    return hn::Set(d, std::exp2(hn::GetLane(x)));
  } else {
    static_assert(kDegree == 4 || kDegree == 5);
    const hn::RebindToSigned<D> di;
    const auto magic = hn::Set(d, 12582912.0f);  // 1.5 * 2^23: adding it leaves round(x) in the low bits
    const auto shifted = hn::Add(x, magic);
    const auto f = hn::Sub(x, hn::Sub(shifted, magic));
    // Minimax of 2^f on [-1/2, 1/2]: relative error 2.6e-6 or 7.5e-8
    static constexpr float four[] = {0.9999992614f, 0.6931218147f, 0.2402474483f, 0.05591786032f, 0.009570101908f};
    static constexpr float five[] = {1.000000072f,   0.6931469671f,   0.2402211972f,
                                     0.05550713274f, 0.009675541385f, 0.001327647205f};
    constexpr const float* c = kDegree == 4 ? four : five;
    auto p = hn::Set(d, c[kDegree]);
    for (int n = kDegree - 1; n >= 0; --n) p = hn::MulAdd(p, f, hn::Set(d, c[n]));
    return hn::BitCast(d, hn::Add(hn::BitCast(di, p), hn::ShiftLeft<23>(hn::BitCast(di, shifted))));
  }
}

// 1 / x for x > 0. float: estimate and one Newton step, relative error < 5e-7.
template <class D>
HWY_INLINE hn::Vec<D> Reciprocal(D d, hn::Vec<D> x) {
  const auto one = hn::Set(d, hn::TFromD<D>(1));
  if constexpr (sizeof(hn::TFromD<D>) == 8) {
    return hn::Div(one, x);
  } else {
    const auto r = hn::ApproximateReciprocal(x);
    return hn::MulAdd(r, hn::NegMulAdd(x, r, one), r);
  }
}

// Lane i receives table[channel[i]]; the table holds r, g, b and one number of padding.
template <class D>
HWY_INLINE hn::Vec<D> Lookup(D d, const hn::TFromD<D>* HWY_RESTRICT table, hn::Vec<hn::RebindToSigned<D>> channel) {
  if constexpr (sizeof(hn::TFromD<D>) == 8) {
    return hn::Set(d, table[hn::GetLane(channel)]);
  } else {
    return hn::TableLookupLanes(hn::LoadDup128(d, table), hn::IndicesFromVec(d, channel));
  }
}

// alpha = min(0.99, 2^power), zero where power is below the cut (or is not a number).
template <class D>
HWY_INLINE hn::Vec<D> Alpha(D d, hn::Vec<D> power, hn::Vec<D> cut) {
  const auto alpha = hn::Min(Exp2(d, power), hn::Set(d, hn::TFromD<D>(kMaxAlpha)));
  return hn::IfThenElseZero(hn::Ge(power, cut), alpha);
}
template <class D>
HWY_INLINE hn::Vec<D> Alpha(D d, hn::Vec<D> power) {
  return Alpha(d, power, hn::Set(d, hn::TFromD<D>(kLog2MinAlpha)));
}

}  // namespace HWY_NAMESPACE
}  // namespace lfgs
HWY_AFTER_NAMESPACE();

#endif  // LFGS_MATH_BLEND_INL_H_
