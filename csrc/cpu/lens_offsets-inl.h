// The offsets that sub-pixels show, from their phases.

#if defined(LFGS_CPU_LENS_OFFSETS_INL_H_) == defined(HWY_TARGET_TOGGLE)
#ifdef LFGS_CPU_LENS_OFFSETS_INL_H_
#undef LFGS_CPU_LENS_OFFSETS_INL_H_
#else
#define LFGS_CPU_LENS_OFFSETS_INL_H_
#endif

#include "hwy/highway.h"
#include "math/blend-inl.h"
#include "scene/lens.h"

HWY_BEFORE_NAMESPACE();
namespace lfgs {
namespace HWY_NAMESPACE {

// Normalized offsets of the samples at a vector's phases, which go on to the next sub-pixel. Exact but for the last
// rounding.
template <class T>
HWY_INLINE hn::Vec<Tag<T>> next_offsets(const Lens& lens, uint64_t* HWY_RESTRICT phases) {
  const Tag<T> d;
  constexpr int kLanes = int(hn::MaxLanes(Tag<T>()));
  if constexpr (kLanes == 1) {
    const uint64_t phase = *phases;
    *phases += lens.phase_x;
    return hn::Set(d, T(lens.s_start() + lens.s_step() * camera_coordinate(lens, phase)));
  } else {
    // camera_coordinate in halves of a vector, as integers: the view, or x as a fraction of 2^31
    const hn::RebindToSigned<Tag<T>> di;
    const hn::RepartitionToWide<hn::RebindToUnsigned<Tag<T>>> d64;
    const hn::RebindToUnsigned<Tag<T>> d32;
    const auto views = hn::BitCast(d32, hn::Set(d64, uint64_t(lens.views)));
    auto next = [&](uint64_t* at) {
      const auto phase = hn::Load(d64, at), high = hn::ShiftRight<32>(phase);
      hn::Store(hn::Add(phase, hn::Set(d64, lens.phase_x)), d64, at);
      if (lens.continuous) return hn::BitCast(d32, hn::ShiftRight<1>(high));
      const auto carry = hn::ShiftRight<32>(hn::MulEven(hn::BitCast(d32, phase), views));
      return hn::BitCast(d32, hn::ShiftRight<32>(hn::Add(hn::MulEven(hn::BitCast(d32, high), views), carry)));
    };
    const auto low = next(phases), integers = hn::ConcatEven(d32, next(phases + kLanes / 2), low);
    const double unit = lens.continuous ? double(lens.views) / 2147483648.0 : 1, half = lens.continuous ? 0 : 0.5;
    return hn::MulAdd(hn::ConvertTo(d, hn::BitCast(di, integers)), hn::Set(d, T(lens.s_step() * unit)),
                      hn::Set(d, T(lens.s_start() + lens.s_step() * half)));
  }
}

}  // namespace HWY_NAMESPACE
}  // namespace lfgs
HWY_AFTER_NAMESPACE();

#endif  // LFGS_CPU_LENS_OFFSETS_INL_H_
