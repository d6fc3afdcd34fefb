// Stage weave. Each sub-pixel gathers four samples of each view that it mixes. A row of the panel reads a row or two of
// every view, one after the other. So these rows stay in the cache for the next row of the panel.
#include "stages/weave.h"

#include <algorithm>
#include <cmath>
#include <type_traits>
#include <vector>
#include <cstdint>

#include "base/parallel.h"

namespace lfgs {
namespace {

// Views first .. first + count - 1; weights sum to 1.
struct WeaveMix {
  int64_t first = 0, count = 0;
  const float* weights = nullptr;
};

// How many views a box touches at most.
inline int64_t most_mixed(const WeaveFan& fan) { return std::min(fan.views, int64_t(std::ceil(fan.box)) + 1); }

// Each view covers the places nearer to it than to another view, and the outermost views cover all beyond. Its weight
// is the fraction of the box around `place` that it covers. A box of one view is linear interpolation. weights
// [most_mixed].
inline WeaveMix mix_at(const WeaveFan& fan, double place, float* weights) {
  const int64_t last = fan.views - 1;
  const auto to_view = [&](double x) { return std::clamp(int64_t(x), int64_t(0), last); };
  if (fan.box == 0) return weights[0] = 1, WeaveMix{to_view(std::floor(place + 0.5)), 1, weights};
  const double low = place - fan.box / 2, high = place + fan.box / 2;
  const int64_t first = to_view(std::floor(low + 0.5));
  const int64_t end = std::min(to_view(std::ceil(high + 0.5) - 1) + 1, first + most_mixed(fan));
  for (int64_t view = first; view < end; ++view) {
    const double from = view == 0 ? low : std::max(low, double(view) - 0.5);
    const double to = view == last ? high : std::min(high, double(view) + 0.5);
    weights[view - first] = float(std::max(0.0, to - from) / fan.box);
  }
  return {first, end - first, weights};
}

// The mixes of all of a panel's views; made once.
class WeaveMixes {
 public:
  explicit WeaveMixes(const WeaveFan& fan) : weights_(size_t(fan.map.views * most_mixed(fan))) {
    mixes_.reserve(size_t(fan.map.views));
    for (int64_t view = 0; view < fan.map.views; ++view)
      mixes_.push_back(mix_at(fan, fan.places[view], weights_.data() + view * most_mixed(fan)));
  }
  const WeaveMix& operator[](int64_t view) const { return mixes_[size_t(view)]; }

 private:
  std::vector<float> weights_;
  std::vector<WeaveMix> mixes_;
};

constexpr int64_t kRows = 8;  // of the panel, a work item
// Places are rounded to fractions of a pixel: where sizes agree they fall on pixels, whatever the rounding
constexpr double kParts = 65536;

// The two pixels beside a place along a side of a picture, and how much of the second is mixed in.
struct Tap {
  int64_t first, second;
  float weight;
  bool inside;
};

Tap tap_at(double place, int64_t size, double least, double most) {
  const double exact = std::nearbyint((place * double(size) - 0.5) * kParts) / kParts;
  const double pixel = std::clamp(exact, 0.0, double(size - 1));
  const int64_t first = int64_t(pixel);
  return {first, std::min(first + 1, size - 1), float(pixel - double(first)),
          place >= least - 1 / kParts && place <= most + 1 / kParts};
}

template <class T>
T stored(float value) {
  if constexpr (std::is_same_v<T, float>) {
    return value;
  } else {  // ties to even, the rounding mode that a process starts with
    return T(std::lrint(std::clamp(value, 0.0f, float(T(-1)))));
  }
}

inline float mixed(float a, float b, float weight) { return a + weight * (b - a); }

// A pass over the panel for the views that are held.
template <class T>
class Weaver {
 public:
  Weaver(const WeaveViews<T>& views, const WeaveWindow& window, const WeaveFan& fan, T* out)
      : views_(views), window_(window), fan_(fan), out_(out) {
    const int64_t width = fan.map.width_px;
    places_.reserve(size_t(width)), columns_.reserve(size_t(width)), shifts_.reserve(size_t(fan.views));
    for (int64_t column = 0; column < width; ++column) {
      places_.push_back(window.left + (double(column) + 0.5) * (window.width / double(width)));
      columns_.push_back(across(places_.back()));
    }
    for (int64_t view = 0; view < fan.views; ++view)
      shifts_.push_back(window.shift * ((double(view) + 0.5) / double(fan.views) - 0.5));
  }

  // Call to_mix(column, channel) for the mix of every sub-pixel of a row, whose count is 0 where nothing is shown.
  template <class MixOf>
  void draw_row(int64_t row, const MixOf& to_mix) const {
    const int64_t width = fan_.map.width_px;
    const double place = window_.top + (double(row) + 0.5) * (window_.height / double(fan_.map.height_px));
    const Tap down = tap_at(place, views_.height_px, window_.low_y, window_.high_y);
    if (!down.inside) return;
    for (int64_t column = 0; column < width; ++column)
      for (int channel = 0; channel < 3; ++channel) {
        const WeaveMix mix = to_mix(column, channel);
        if (mix.count > 0 && mix.first >= views_.first && mix.first < views_.first + views_.own)
          draw(mix, down, column, channel, out_[(row * width + column) * 3 + channel]);
      }
  }

 private:
  Tap across(double place) const { return tap_at(place, views_.width_px, window_.low_x, window_.high_x); }

  // The mean of those views that reach there; nothing where none does.
  void draw(const WeaveMix& mix, const Tap& down, int64_t column, int channel, T& out) const {
    float value = 0, total = 0;
    for (int64_t k = 0; k < mix.count; ++k) {
      if (mix.weights[k] == 0) continue;
      const int64_t view = mix.first + k;
      const Tap tap =
          window_.shift == 0 ? columns_[size_t(column)] : across(places_[size_t(column)] - shifts_[size_t(view)]);
      if (!tap.inside) continue;
      const float colour = sample(view - views_.first, down, tap, channel);
      // A running mean: where all views agree, it is their colour to the bit
      total += mix.weights[k];
      value = total == mix.weights[k] ? colour : mixed(value, colour, mix.weights[k] / total);
    }
    if (total > 0) out = stored<T>(value);
  }

  float sample(int64_t slot, const Tap& down, const Tap& tap, int channel) const {
    const T* picture = views_.pixels + slot * views_.height_px * views_.width_px * 3 + channel;
    const float upper = along(picture + down.first * views_.width_px * 3, tap);
    if (down.weight == 0) return upper;
    return mixed(upper, along(picture + down.second * views_.width_px * 3, tap), down.weight);
  }

  static float along(const T* row, const Tap& tap) {
    const float left = float(row[3 * tap.first]);
    return tap.weight == 0 ? left : mixed(left, float(row[3 * tap.second]), tap.weight);
  }

  WeaveViews<T> views_;
  WeaveWindow window_;
  WeaveFan fan_;
  T* out_;
  std::vector<double> places_, shifts_;  // of the panel's columns, in fractions of a view; of the views
  std::vector<Tap> columns_;             // of views without a shift
};

// The phases of a row's sub-pixels by column and channel. Cells repeat every kCellPeriod columns.
class RowPhases {
 public:
  RowPhases(const Lens& lens, int64_t row) : step_(lens.phase_x * 3) {
    for (int64_t column = 0; column < kCellPeriod; ++column)
      for (int channel = 0; channel < 3; ++channel)
        first_[column][channel] = lens.true_phase(row, lens.subpixel_index(row, column, channel));
  }
  uint64_t at(int64_t column, int channel) const {
    const int64_t within = column % kCellPeriod;
    return first_[within][channel] + step_ * uint64_t(column - within);
  }

 private:
  uint64_t first_[kCellPeriod][3], step_;
};

double place_index(const WeaveFan& fan, uint64_t phase) {
  const double panel_views = double(fan.map.lens.views), views = double(fan.views);
  const double x = double(phase >> 11) * (0x1p-53 * panel_views);  // 53 bits convert exactly
  const double at = fan.inverted ? x : panel_views - x;
  return std::clamp((at * views - 0.5 * panel_views) / panel_views, 0.0, views - 1);
}

}  // namespace

template <class T>
void weave(const WeaveViews<T>& views, const WeaveWindow& window, const WeaveFan& fan, T* out, int threads) {
  const Weaver<T> weaver(views, window, fan, out);
  const ViewMap& map = fan.map;
  const auto over_rows = [&](const auto& draw) {
    parallel_for_chunks(map.height_px, kRows, threads, [&](int64_t begin, int64_t end, int) {
      for (int64_t row = begin; row < end; ++row) draw(row);
    });
  };
  if (fan.continuous) {
    over_rows([&](int64_t row) {
      const RowPhases phases(map.lens, row);
      std::vector<float> weights(size_t(most_mixed(fan)));
      weaver.draw_row(row, [&](int64_t column, int channel) {
        return mix_at(fan, place_index(fan, phases.at(column, channel)), weights.data());
      });
    });
    return;
  }
  const WeaveMixes mixes(fan);
  if (map.table) {
    over_rows([&](int64_t row) {
      weaver.draw_row(row, [&](int64_t column, int channel) {
        const int64_t view = map.at(row, column, channel);
        return view < 0 || view >= map.views ? WeaveMix{} : mixes[view];
      });
    });
    return;
  }
  over_rows([&](int64_t row) {
    const RowPhases phases(map.lens, row);
    weaver.draw_row(row, [&](int64_t column, int channel) {
      return mixes[integer_view(phases.at(column, channel), uint64_t(map.lens.views))];
    });
  });
}

template void weave(const WeaveViews<uint8_t>&, const WeaveWindow&, const WeaveFan&, uint8_t*, int);
template void weave(const WeaveViews<uint16_t>&, const WeaveWindow&, const WeaveFan&, uint16_t*, int);
template void weave(const WeaveViews<float>&, const WeaveWindow&, const WeaveFan&, float*, int);

}  // namespace lfgs
