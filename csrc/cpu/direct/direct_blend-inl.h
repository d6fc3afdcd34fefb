// Blend one splat into the samples of a tile of lenses, or sum the gradient that these samples give to the splat. Also
// begin and finish a tile. composite_direct.cpp calls this splat by splat, nearest first.

#if defined(LFGS_CPU_DIRECT_BLEND_INL_H_) == defined(HWY_TARGET_TOGGLE)
#ifdef LFGS_CPU_DIRECT_BLEND_INL_H_
#undef LFGS_CPU_DIRECT_BLEND_INL_H_
#else
#define LFGS_CPU_DIRECT_BLEND_INL_H_
#endif

#include <algorithm>
#include <type_traits>

#include "cpu/direct/direct_job.h"
#include "cpu/direct/direct_lines-inl.h"
#include "cpu/direct/direct_splat-inl.h"
#include "cpu/direct/direct_tile-inl.h"
#include "hwy/highway.h"
#include "math/blend-inl.h"
#include "math/over-inl.h"

HWY_BEFORE_NAMESPACE();
namespace lfgs {
namespace HWY_NAMESPACE {

// Blend a splat into the `count` vectors that tile.find() has listed. It is never inlined, so that the splat's
// constants stay in registers.
template <class Footprint, int kOrder, class T>
HWY_NOINLINE void ForwardSplat(const DirectJob<T>& job, DirectTile<T>& tile, const T* background, int32_t id,
                               const Footprint& shape, int64_t count) {
  constexpr int kLanes = DirectTile<T>::kLanes,
                kStep = 4;    // vectors at once: they share one test for samples that stop
  constexpr int kChunk = 16;  // vectors whose powers, alphas and colours follow each other
  using V = typename DirectTile<T>::V;
  const Tag<T> d;
  const hn::RebindToSigned<Tag<T>> di;
  const Footprint footprint = shape;
  const T *xs = tile.x.get(), *ss = tile.s.get(), *colour = colours(job.splats, id);
  T *colours = tile.colour.get(), *transmittances = tile.transmittance.get();
  const int order = job.splats.orders[id];
  const V least_after = hn::Set(d, T(job.quality.stop));
  // Positive floats compare like their bits. With one subtracted, the zero of a sample that has stopped already becomes
  // the largest number. So the smallest is below the limit only where a sample stops now.
  const hn::RebindToUnsigned<Tag<T>> du;
  const auto one = hn::Set(du, 1), limit = hn::Sub(hn::BitCast(du, least_after), one);
  const bool ends_early = job.quality.ends_early();

  auto blend = [&](auto vectors, const uint16_t* list, const T* alphas) {
    // Weights, and the light that is left
    V weights[vectors], afters[vectors];
    auto least = limit;
    for (int n = 0; n < vectors; ++n) {
      const int64_t i = list[n];
      const V before = hn::Load(d, transmittances + i);
      weights[n] = hn::Mul(hn::Load(d, alphas + n * kLanes), before);
      afters[n] = hn::Sub(before, weights[n]);
      least = hn::Min(least, hn::Sub(hn::BitCast(du, afters[n]), one));
    }
    const bool stops = !hn::AllTrue(du, hn::Eq(least, limit));

    // Colours
    for (int n = 0; n < vectors; ++n) {
      const int64_t i = list[n];
      const auto channel = hn::Load(di, &tile.channel[i]);
      V weight = weights[n], after = afters[n], c = ColourAt<kOrder>(d, colour, order, channel, hn::Load(d, ss + i));

      // A sample whose transmittance would fall too low ends here. The light that is left goes to the background, or to
      // this splat where samples end early
      if (HWY_UNLIKELY(stops)) {
        const auto stop = hn::Lt(after, least_after);
        weight = hn::IfThenElse(stop, hn::Load(d, transmittances + i), weight);
        if (!ends_early) c = hn::IfThenElse(stop, Lookup(d, background, channel), c);
        after = hn::IfThenZeroElse(stop, after);
        if (hn::AllTrue(d, hn::Eq(after, hn::Zero(d)))) tile.retire(list[n]);
      }
      hn::Store(hn::MulAdd(weight, c, hn::Load(d, colours + i)), d, colours + i);
      hn::Store(after, d, transmittances + i);
    }
  };

  // First the powers of a few vectors, then their alphas, then their colours. Each is a chain of dependent operations.
  // A processor works on more chains at a time when they are short.
  alignas(64) T values[kChunk * kLanes];
  for (const uint16_t *list = tile.list(), *all = list + count; list < all;) {
    const int some = int(std::min<int64_t>(all - list, kChunk));
    for (int n = 0; n < some; ++n) {
      const int64_t i = list[n];
      hn::Store(footprint.power(hn::Load(d, xs + i), hn::Load(d, ss + i), tile.rows(list[n])), d, values + n * kLanes);
    }
    for (int n = 0; n < some; ++n) {
      T* value = values + n * kLanes;
      hn::Store(footprint.alpha(hn::Load(d, value), hn::Load(d, ss + list[n])), d, value);
    }
    int n = 0;
    for (; n + kStep <= some; n += kStep) blend(std::integral_constant<int, kStep>(), list + n, values + n * kLanes);
    for (; n < some; ++n) blend(std::integral_constant<int, 1>(), list + n, values + n * kLanes);
    list += some;
  }
}

// Call visit with the order of a colour polynomial, as a constant where it is small. Else it is -1: also of a colour
// on a circle.
template <class Visit>
void with_order(int order, const Visit& visit) {
  switch (order) {
    case 0:
      return visit(std::integral_constant<int, 0>());
    case 1:
      return visit(std::integral_constant<int, 1>());
    case 2:
      return visit(std::integral_constant<int, 2>());
    default:
      return visit(std::integral_constant<int, -1>());
  }
}

// Blend a splat by the cheapest code that is near enough for it.
template <class T>
void Forward(const DirectJob<T>& job, DirectTile<T>& tile, const T* background, int32_t id, const TileSplat<T>& splat,
             int64_t count) {
  const Compensation<T>* compensation = job.splats.compensations ? job.splats.compensations + id : nullptr;
  with_footprint(splat, compensation, job.quality, [&](const auto& footprint) {
    with_order(job.splats.orders[id], [&](auto order) {
      ForwardSplat<std::decay_t<decltype(footprint)>, order>(job, tile, background, id, footprint, count);
    });
  });
}

// Blend a splat by an approximate footprint. This does not look for samples that stop; DirectTile::retire_below does,
// from time to time.
template <class Footprint, int kOrder>
HWY_NOINLINE void ApproximateSplat(const DirectJob<float>& job, DirectTile<float>& tile, int32_t id,
                                   const Footprint& shape) {
  const Tag<float> d;
  const hn::RebindToSigned<Tag<float>> di;
  const Footprint footprint = shape;
  const float *xs = tile.x.get(), *ss = tile.s.get(), *colour = colours(job.splats, id);
  float *colours = tile.colour.get(), *transmittances = tile.transmittance.get();
  const int32_t* channels = tile.channel.get();
  const int order = job.splats.orders[id];
  tile.for_each_group([&](const auto& of_group, const uint16_t* list, const uint16_t* end) {
    const RowVectors<Tag<float>> rows(of_group);
    for (; list < end; ++list) {
      const int64_t i = *list;
      const auto s = hn::Load(d, ss + i), before = hn::Load(d, transmittances + i);
      const auto weight = footprint.weight(hn::Load(d, xs + i), s, rows, before);
      const auto c = ColourAt<kOrder>(d, colour, order, hn::Load(di, channels + i), s);
      hn::Store(hn::MulAdd(weight, c, hn::Load(d, colours + i)), d, colours + i);
      hn::Store(hn::Sub(before, weight), d, transmittances + i);
    }
  });
}

// Add the background and write the tile to the image, where the sub-pixels of a pixel lie in the order of their
// places for now. Return how many samples had stopped.
template <class T>
int64_t FinishTile(const DirectJob<T>& job, DirectTile<T>& tile, int64_t samples, const T* background) {
  const Tag<T> d;
  const hn::RebindToSigned<Tag<T>> di;
  const hn::RebindToUnsigned<Tag<T>> du;
  const hn::Rebind<uint8_t, Tag<T>> d8;
  constexpr int kLanes = DirectTile<T>::kLanes;
  const auto darkest = hn::Set(d, T(job.quality.darkest()));

  // Add the background, and make bytes where they are wanted
  int64_t stopped = 0;
  uint8_t* bytes = reinterpret_cast<uint8_t*>(tile.transmittance.get());  // overwrites numbers that were read already
  for (int64_t i = 0; i < samples; i += kLanes) {
    const auto b = Lookup(d, background, hn::Load(di, &tile.channel[i]));
    const auto left = hn::Load(d, &tile.transmittance[i]), c = hn::MulAdd(left, b, hn::Load(d, &tile.colour[i]));
    stopped += int64_t(hn::CountTrue(d, hn::Lt(left, darkest)));
    if (job.out8) {
      const auto unit = hn::Min(hn::Max(c, hn::Zero(d)), hn::Set(d, T(1)));
      const auto rounded = hn::ConvertTo(di, hn::Round(hn::Mul(unit, hn::Set(d, T(255)))));
      hn::Store(hn::TruncateTo(d8, hn::BitCast(du, rounded)), d8, bytes + i);
    } else {
      hn::Store(c, d, &tile.colour[i]);
    }
  }

  // Write the sub-pixels, bytes through DirectLines where that pays
  auto write = [&](const auto* from, auto* image) {
    tile.for_each_run([&](const auto& run) {
      auto* to = image + run.row * 3 * job.lens->width_px + run.first;
      for (int64_t t = 0, sample = tile.sample(run); t < run.count; ++t) to[t] = from[sample + t * kLanes];
    });
  };
  if (!job.out8)
    write(tile.colour.get(), job.out);
  else if (DirectLines<T>::pays(tile.lens_columns()))
    DirectLines<T>(tile, bytes, reinterpret_cast<uint8_t*>(tile.s.get())).write(job.out8, 3 * job.lens->width_px);
  else
    write(bytes, job.out8);
  return stopped;
}

// Gradient sums for the compensation of a splat, a vector each. They follow from the gradient of log2 alpha, for log2
// of the compensation is (log2 D(s) - log2 S(s)) / 2.
template <class D>
struct CompensationSums {
  using V = hn::Vec<D>;
  V D0, D1, D2, S0, S1, S2;

  explicit HWY_INLINE CompensationSums(D d) { D0 = D1 = D2 = S0 = S1 = S2 = hn::Zero(d); }
  // g: the gradient of log2 alpha.
  HWY_INLINE void Add(D d, V g, V D_at_s, V inverse_S, V s) {
    const V half = hn::Mul(g, hn::Set(d, hn::TFromD<D>(0.5 / kLn2))), gD = hn::Div(half, D_at_s);
    const V of_D = hn::IfThenElseZero(hn::Gt(D_at_s, hn::Zero(d)), gD), of_S = hn::Neg(hn::Mul(half, inverse_S));
    const V D_s = hn::Mul(of_D, s), S_s = hn::Mul(of_S, s);
    D0 = hn::Add(D0, of_D), D1 = hn::Add(D1, D_s), D2 = hn::MulAdd(D_s, s, D2);
    S0 = hn::Add(S0, of_S), S1 = hn::Add(S1, S_s), S2 = hn::MulAdd(S_s, s, S2);
  }
  // Add the sums to the gradients of the splat and of its compensation.
  HWY_INLINE void Reduce(D d, Splat<hn::TFromD<D>>& splat, Compensation<hn::TFromD<D>>& compensation) const {
    auto sum = [&](V v) { return hn::GetLane(hn::SumOfLanes(d, v)); };
    splat.S0 += sum(S0), splat.S1 += sum(S1), splat.S2 += sum(S2);
    compensation.D0 += sum(D0), compensation.D1 += sum(D1), compensation.D2 += sum(D2);
  }
};

// The derivative of a splat's colour by the samples' offsets, before the colour is clamped at zero.
template <class D>
HWY_INLINE hn::Vec<D> ColourSlope(D d, const hn::TFromD<D>* colour, int order, hn::Vec<hn::RebindToSigned<D>> channel,
                                  hn::Vec<D> s) {
  if (HWY_UNLIKELY(order == kCircleOrder)) {  // the angle grows by h^2 / distance
    const CirclePoints<D> point(d, colour, s);
    const auto per_s = hn::Div(hn::Mul(point.h, point.h), hn::Set(d, colour[kDistanceTerm * kColourStride + 3]));
    return hn::Mul(point.slope(d, colour, channel), per_s);
  }
  auto slope = hn::Zero(d);
  for (int p = order; p >= 1; --p) {
    const auto term = hn::Mul(hn::Set(d, hn::TFromD<D>(p)), Lookup(d, colour + p * kColourStride, channel));
    slope = hn::MulAdd(slope, s, term);
  }
  return slope;
}

// The derivative of a quadratic k0 + k1 s + k2 s^2.
template <class D>
HWY_INLINE hn::Vec<D> QuadraticSlope(D d, hn::TFromD<D> k1, hn::TFromD<D> k2, hn::Vec<D> s) {
  return hn::MulAdd(hn::Set(d, 2 * k2), s, hn::Set(d, k1));
}

// Add to `out` the gradient of an intersection, from the samples of this tile. math/over-inl.h has
// the formula; a sample has one channel here. kOffsets: also add to the gradients of the samples' offsets.
template <bool kCompensated, bool kOffsets, class T>
void BackwardSplat(const DirectJob<T>& job, DirectTile<T>& tile, int32_t id, const IntersectionGradient<T>& out) {
  using V = typename DirectTile<T>::V;
  const Tag<T> d;
  const hn::RebindToSigned<Tag<T>> di;
  const Splat<T>& splat = job.splats.splats[id];
  const ExactFootprint<T> footprint(splat, T(kLog2MinAlpha));
  const T* colour = colours(job.splats, id);
  const int order = job.splats.orders[id], terms = colour_terms(order);
  SplatSums<Tag<T>> sums(d);
  [[maybe_unused]] CompensationSums<Tag<T>> compensation_sums(d);
  [[maybe_unused]] const CompensationFactor<T> factor(kCompensated ? job.splats.compensations[id] : Compensation<T>{});
  V g_colour[3 * (kMaxColourOrder + 1)], g_along = hn::Zero(d), g_across = hn::Zero(d);
  for (int k = 0; k < 3 * terms; ++k) g_colour[k] = hn::Zero(d);
  bool touched = false;
  auto backward = [&](uint16_t sample, const RowVectors<Tag<T>>& rows, V dy) {
    // Alpha again, and the transmittance before the splat
    const int64_t i = sample;
    const V s = hn::Load(d, &tile.s[i]);
    V dx, inverse_S;
    const V power = footprint.power(hn::Load(d, &tile.x[i]), s, rows, dx, inverse_S);
    V alpha;
    if constexpr (kCompensated)
      alpha = CompensatedAlpha(d, power, factor.at(s, inverse_S), footprint.cut, hn::Set(d, T(kMinAlpha)));
    else
      alpha = Alpha(d, power);
    V before;
    const auto stop = OverAgain(d, alpha, &tile.transmittance[i], before);
    const V g = hn::Load(d, &tile.gradient[i]);
    const auto channel = hn::Load(di, &tile.channel[i]);
    if (HWY_UNLIKELY(!hn::AllFalse(d, stop))) {
      // In the backward pass `colour` keeps what each sample that stopped lets through to the background
      hn::Store(hn::Add(hn::Load(d, &tile.colour[i]), hn::IfThenElseZero(stop, before)), d, &tile.colour[i]);
      if (hn::AllTrue(d, hn::Or(stop, hn::Eq(before, hn::Zero(d))))) tile.retire(sample);
    }
    const auto lit = hn::Gt(alpha, hn::Zero(d));
    if (hn::AllFalse(d, lit)) return;
    touched = true;

    // Gradients of alpha and of the exponent
    const V c = order == 0 ? ColourAt<0>(d, colour, 0, channel, s) : ColourAt<-1>(d, colour, order, channel, s);
    const V weight = hn::Mul(alpha, before), v = hn::Mul(g, c);
    const V g_alpha = OverBackward<false>(d, alpha, before, weight, v, &tile.total[i], &tile.prefix[i]);
    auto free = hn::Lt(power, hn::Set(d, T(kLog2MaxAlpha)));
    if constexpr (kCompensated) free = hn::Lt(alpha, hn::Set(d, T(kMaxAlpha)));
    const V g_power = ExponentBackward(d, g_alpha, alpha, hn::And(lit, free));
    sums.Add(g_power, dy, hn::Mul(dx, inverse_S), s);
    if constexpr (kCompensated) compensation_sums.Add(d, g_power, factor.unfiltered(s), inverse_S, s);

    // Colour coefficients, where the clamp at zero does not hold. Projection clamps colours of order 0, and its
    // backward pass masks their gradients.
    V g_c = hn::Mul(g, weight);
    if (order != 0) g_c = hn::IfThenElseZero(hn::Gt(c, hn::Zero(d)), g_c);
    if constexpr (kOffsets) {
      // The mean of the footprint in this row moves by M1, and S(s) changes
      const V along = hn::Mul(dx, inverse_S), S_slope = QuadraticSlope(d, splat.S1, splat.S2, s);
      V by_s = hn::Mul(along, hn::MulAdd(along, S_slope, hn::Mul(hn::Set(d, T(2)), rows.M1)));
      if constexpr (kCompensated) {
        const auto& D_of = job.splats.compensations[id];
        const V D_at_s = factor.unfiltered(s), D_slope = hn::Div(QuadraticSlope(d, D_of.D1, D_of.D2, s), D_at_s);
        const V of_D = hn::IfThenElseZero(hn::Gt(D_at_s, hn::Zero(d)), D_slope);
        by_s = hn::MulAdd(hn::NegMulAdd(S_slope, inverse_S, of_D), hn::Set(d, T(0.5 / kLn2)), by_s);
      }
      const V g_s = hn::MulAdd(g_power, by_s, hn::Mul(g_c, ColourSlope(d, colour, order, channel, s)));
      hn::Store(hn::Add(hn::Load(d, &tile.g_offset[i]), g_s), d, &tile.g_offset[i]);
    }
    auto in_channel = [&](int k) {
      return hn::IfThenElseZero(hn::RebindMask(d, hn::Eq(channel, hn::Set(di, typename DirectTile<T>::TI(k)))), g_c);
    };
    if (HWY_UNLIKELY(order == kCircleOrder)) {
      const CirclePoints<Tag<T>> point(d, colour, s);
      for (int k = 0; k < 3; ++k) {
        V term = in_channel(k), with_h = hn::Mul(term, point.h);
        for (int m = 0; m < 4; ++m, term = hn::Mul(term, point.t))
          g_colour[3 * m + k] = hn::Add(g_colour[3 * m + k], term);
        for (int m = 4; m < 7; ++m, with_h = hn::Mul(with_h, point.t))
          g_colour[3 * m + k] = hn::Add(g_colour[3 * m + k], with_h);
      }
      const V g_angle = hn::Mul(g_c, hn::Mul(point.slope(d, colour, channel), point.h));
      g_along = hn::MulAdd(g_angle, point.h, g_along), g_across = hn::MulAdd(g_angle, point.t, g_across);
      return;
    }
    for (int k = 0; k < 3; ++k) {
      V term = in_channel(k);
      for (int p = 0; p <= order; ++p, term = hn::Mul(term, s))
        g_colour[3 * p + k] = hn::Add(g_colour[3 * p + k], term);
    }
  };
  tile.for_each_group([&](const auto& of_group, const uint16_t* list, const uint16_t* end) {
    const RowVectors<Tag<T>> rows(of_group);
    for (; list < end; ++list) backward(*list, rows, hn::Load(d, of_group.dy));
  });

  // Sums over the lanes
  if (!touched) return;
  sums.Reduce(d, splat, out.splat());
  if constexpr (kCompensated) compensation_sums.Reduce(d, out.splat(), out.compensation());
  auto sum = [&](V v) { return hn::GetLane(hn::SumOfLanes(d, v)); };
  for (int k = 0; k < 3 * terms; ++k) out.colours()[k] += sum(g_colour[k]);
  if (order == kCircleOrder) out.colours()[kAlongSum] += sum(g_along), out.colours()[kAcrossSum] += sum(g_across);
}

// Load the inputs of the backward pass at every sample: the gradient of its colour, and the total of math/over-inl.h
// (gradient times colour).
template <class T>
void LoadGradients(const DirectJob<T>& job, DirectTile<T>& tile, int64_t samples) {
  constexpr int kLanes = DirectTile<T>::kLanes;
  for (auto* a : {&tile.gradient, &tile.total, &tile.prefix, &tile.g_offset})
    if (*a) std::fill(a->get(), a->get() + samples, T(0));
  tile.for_each_run([&](const auto& run) {
    int64_t sample = tile.sample(run);
    for (int64_t m = run.first; m < run.first + run.count; ++m, sample += kLanes) {
      const int64_t from = run.row * 3 * job.lens->width_px + m / 3 * 3 + tile.channel[sample];
      tile.gradient[sample] = job.gradient[from];
      tile.total[sample] = job.gradient[from] * job.image[from];
    }
  });
}

// Write the gradients of the samples' offsets to the sub-pixels.
template <class T>
void StoreOffsetGradients(const DirectJob<T>& job, const DirectTile<T>& tile) {
  tile.for_each_run([&](const auto& run) {
    int64_t sample = tile.sample(run);
    for (int64_t m = run.first; m < run.first + run.count; ++m, sample += DirectTile<T>::kLanes)
      job.g_offsets[run.row * 3 * job.lens->width_px + m / 3 * 3 + tile.channel[sample]] = tile.g_offset[sample];
  });
}

template <class T>
void BackgroundGradient(const DirectTile<T>& tile, int64_t samples, T* out) {
  for (int64_t i = 0; i < samples; ++i)
    out[tile.channel[i]] += tile.gradient[i] * (tile.colour[i] + tile.transmittance[i]);
}

}  // namespace HWY_NAMESPACE
}  // namespace lfgs
HWY_AFTER_NAMESPACE();

#endif  // LFGS_CPU_DIRECT_BLEND_INL_H_
