// The loss of images against photographs, and its gradient. There are two passes over bands of rows. The first blurs
// the five moments and finds SSIM and its derivatives; the second blurs the derivatives and writes the gradient.
// Samples of a row lie side by side, red, green, blue. So taps of the window are three samples apart, and the loops run
// over whole rows. The compiler vectorizes them, once for every instruction set.
#include <algorithm>
#include <vector>

#include "base/config.h"
#include "base/parallel.h"
#include "math/fit/photo_loss.h"
#include "stages/fit.h"

#undef HWY_TARGET_INCLUDE
#define HWY_TARGET_INCLUDE "cpu/fit/photo_loss.cpp"
#include "hwy/foreach_target.h"  // IWYU pragma: keep
#include "hwy/highway.h"

#ifndef LFGS_PHOTO_LOSS_ONCE
#define LFGS_PHOTO_LOSS_ONCE
namespace lfgs {

constexpr int64_t kLossBand = 16;              // rows of a work item
constexpr int64_t kMargin = 3 * kWindowReach;  // samples that a window reaches beyond its own

// Rows of a worker, with zeros beside them where the window reaches beyond the image.
template <class T>
struct Rows {
  int64_t pitch;
  std::vector<T> numbers;
  Rows(int64_t rows, int64_t row) : pitch(row + 2 * kMargin), numbers(rows * pitch) {}
  T* operator[](int64_t r) { return numbers.data() + r * pitch + kMargin; }  // from the first sample of the image on
  const T* operator[](int64_t r) const { return numbers.data() + r * pitch + kMargin; }
};

// Memory of a worker. It has up to three quantities of the band and of the rows around it that windows reach. It has up
// to five quantities of one row, blurred across rows, then along the row.
template <class T>
struct LossScratch {
  Rows<T> band[3], across, blurred, weights, losses;
  explicit LossScratch(int64_t row)
      : band{{kLossBand + 2 * kWindowReach, row},
             {kLossBand + 2 * kWindowReach, row},
             {kLossBand + 2 * kWindowReach, row}},
        across(5, row),
        blurred(5, row),
        weights(1, row),
        losses(1, row) {}
};

// A band of a view: rows [first, last) of it.
struct LossBand {
  int64_t view, first, last;
};

}  // namespace lfgs
#endif

HWY_BEFORE_NAMESPACE();
namespace lfgs {
namespace HWY_NAMESPACE {

// The blur of one quantity along a row.
template <class T>
HWY_ATTR void blur_along(const T* in, int64_t row, T* __restrict out) {
  for (int64_t j = 0; j < row; ++j) {
    T sum = T(window_tap(kWindowReach)) * in[j];
    LFGS_UNROLL_TAPS
    for (int d = 1; d <= kWindowReach; ++d) sum += T(window_tap(kWindowReach - d)) * (in[j - 3 * d] + in[j + 3 * d]);
    out[j] = sum;
  }
}

// The five moments blurred across rows: x and y are the top row of the window, each `pitch` from the next.
template <class T>
HWY_ATTR void blur_moments(const T* x, const T* y, int64_t pitch, int64_t row, T* __restrict mx, T* __restrict my,
                           T* __restrict mxx, T* __restrict myy, T* __restrict mxy) {
  for (int64_t j = 0; j < row; ++j) {
    T sx = 0, sy = 0, sxx = 0, syy = 0, sxy = 0;
    LFGS_UNROLL_TAPS
    for (int tap = 0; tap < kWindow; ++tap) {
      const T a = x[tap * pitch + j], b = y[tap * pitch + j], weight = T(window_tap(tap));
      const T wa = weight * a, wb = weight * b;
      sx += wa, sy += wb, sxx += wa * a, syy += wb * b, sxy += wa * b;
    }
    mx[j] = sx, my[j] = sy, mxx[j] = sxx, myy[j] = syy, mxy[j] = sxy;
  }
}

// The blur of one quantity across rows.
template <class T>
HWY_ATTR void blur_across(const T* in, int64_t pitch, int64_t row, T* __restrict out) {
  for (int64_t j = 0; j < row; ++j) {
    T sum = T(window_tap(kWindowReach)) * in[kWindowReach * pitch + j];
    LFGS_UNROLL_TAPS
    for (int tap = 0; tap < kWindowReach; ++tap)
      sum += T(window_tap(tap)) * (in[tap * pitch + j] + in[(2 * kWindowReach - tap) * pitch + j]);
    out[j] = sum;
  }
}

// x' and y of row r of a view, and the weights.
template <class T>
HWY_ATTR void read_row(const PhotoLoss<T>& job, int64_t view, int64_t r, T* __restrict x, T* __restrict y,
                       T* __restrict weights) {
  const int64_t row = job.row(), start = (view * job.height_px + r) * row;
  if (job.photo_bytes)
    for (int64_t j = 0; j < row; ++j) y[j] = T(job.photo_bytes[start + j]) * T(1.0 / 255);
  else
    std::copy_n(job.photo + start, row, y);
  if (!job.weights) {
    std::copy_n(job.image + start, row, x);
    std::fill_n(weights, row, T(1));
    return;
  }
  for (int64_t j = 0; j < row; ++j) weights[j] = job.weight_at(start + j);
  for (int64_t j = 0; j < row; ++j) x[j] = job.image_at(start + j, y[j], weights[j]);
}

// SSIM, its derivatives and the loss of a row, from blurred moments.
template <class T>
HWY_ATTR void finish_row(const Rows<T>& moments, const T* x, const T* y, const T* weights, int64_t row, T ssim_lambda,
                         T* __restrict by_x, T* __restrict by_xx, T* __restrict by_xy, T* __restrict losses) {
  const T *mx = moments[0], *my = moments[1], *mxx = moments[2], *myy = moments[3], *mxy = moments[4];
  for (int64_t j = 0; j < row; ++j) {
    const Ssim<T> ssim = compute_ssim(SsimMoments<T>{mx[j], my[j], mxx[j], myy[j], mxy[j]});
    const T w = weights[j];
    by_x[j] = w * ssim.by_x, by_xx[j] = w * ssim.by_xx, by_xy[j] = w * ssim.by_xy;
    losses[j] = sample_loss(x[j], y[j], w, ssim.value, ssim_lambda);
  }
}

// The sum of a row in a fixed order, of eight interleaved sums.
template <class T>
HWY_ATTR double sum_numbers(const T* numbers, int64_t count) {
  double sums[8] = {};
  int64_t j = 0;
  for (; j + 8 <= count; j += 8)
    for (int k = 0; k < 8; ++k) sums[k] += double(numbers[j + k]);
  double sum = 0;
  for (double of_lane : sums) sum += of_lane;
  for (; j < count; ++j) sum += double(numbers[j]);
  return sum;
}

template <class T>
HWY_ATTR void find_derivatives(const PhotoLoss<T>& job, const LossBand& band, LossScratch<T>& scratch) {
  const int64_t row = job.row(), size = job.samples();
  Rows<T>&x = scratch.band[0], &y = scratch.band[1], &weights = scratch.band[2], &blurred = scratch.blurred,
  &across = scratch.across;
  for (int64_t r = band.first - kWindowReach; r < band.last + kWindowReach; ++r) {
    const int64_t at = r - band.first + kWindowReach;
    if (r >= 0 && r < job.height_px)
      read_row(job, band.view, r, x[at], y[at], weights[at]);
    else
      std::fill_n(x[at], row, T(0)), std::fill_n(y[at], row, T(0));
  }
  for (int64_t r = band.first; r < band.last; ++r) {
    const int64_t top = r - band.first, own = top + kWindowReach, line = band.view * job.height_px + r;
    T* out = job.derivatives + line * row;
    blur_moments(x[top], y[top], x.pitch, row, across[0], across[1], across[2], across[3], across[4]);
    for (int m = 0; m < 5; ++m) blur_along<T>(across[m], row, blurred[m]);
    finish_row(blurred, x[own], y[own], weights[own], row, T(job.ssim_lambda), out, out + size, out + 2 * size,
               scratch.losses[0]);
    job.partials[line] = sum_numbers(scratch.losses[0], row);
  }
}

// The gradient of a row, from blurred derivatives.
template <class T>
HWY_ATTR void gradient_row(const Rows<T>& derivatives, const T* x, const T* y, const T* weights, int64_t row,
                           T ssim_lambda, T sample_weight, T* __restrict out) {
  const T *by_x = derivatives[0], *by_xx = derivatives[1], *by_xy = derivatives[2];
  for (int64_t j = 0; j < row; ++j) {
    const T ssim_by_x = ssim_gradient(by_x[j], by_xx[j], by_xy[j], x[j], y[j]);
    out[j] = sample_weight * sample_gradient(x[j], y[j], weights[j], ssim_by_x, ssim_lambda);
  }
}

template <class T>
HWY_ATTR void find_gradient(const PhotoLoss<T>& job, const LossBand& band, LossScratch<T>& scratch) {
  const int64_t row = job.row(), size = job.samples();
  Rows<T>&blurred = scratch.blurred, &across = scratch.across;
  for (int64_t r = band.first - kWindowReach; r < band.last + kWindowReach; ++r) {
    const bool inside = r >= 0 && r < job.height_px;
    const T* from = job.derivatives + (band.view * job.height_px + r) * row;
    for (int d = 0; d < 3; ++d) {
      T* to = scratch.band[d][r - band.first + kWindowReach];
      inside ? std::copy_n(from + d * size, row, to) : std::fill_n(to, row, T(0));
    }
  }
  T *x = blurred[3], *y = blurred[4], *weights = scratch.weights[0];
  for (int64_t r = band.first; r < band.last; ++r) {
    for (int d = 0; d < 3; ++d) {
      blur_across<T>(scratch.band[d][r - band.first], scratch.band[d].pitch, row, across[d]);
      blur_along<T>(across[d], row, blurred[d]);
    }
    read_row(job, band.view, r, x, y, weights);
    gradient_row(blurred, x, y, weights, row, T(job.ssim_lambda), T(job.sample_weight()),
                 job.gradient + (band.view * job.height_px + r) * row);
  }
}

// To be called through Highway's dispatch, which takes no templates.
void derivatives_f32(const PhotoLoss<float>& j, const LossBand& b, LossScratch<float>& s) { find_derivatives(j, b, s); }
void gradient_f32(const PhotoLoss<float>& j, const LossBand& b, LossScratch<float>& s) { find_gradient(j, b, s); }

}  // namespace HWY_NAMESPACE
}  // namespace lfgs
HWY_AFTER_NAMESPACE();

#if HWY_ONCE
namespace lfgs {
namespace {

HWY_EXPORT(derivatives_f32);
HWY_EXPORT(gradient_f32);
void derivatives(const PhotoLoss<float>& job, const LossBand& band, LossScratch<float>& scratch) {
  HWY_DYNAMIC_DISPATCH(derivatives_f32)(job, band, scratch);
}
void derivatives(const PhotoLoss<double>& job, const LossBand& band, LossScratch<double>& scratch) {
  HWY_STATIC_DISPATCH(find_derivatives)(job, band, scratch);
}
void gradient(const PhotoLoss<float>& job, const LossBand& band, LossScratch<float>& scratch) {
  HWY_DYNAMIC_DISPATCH(gradient_f32)(job, band, scratch);
}
void gradient(const PhotoLoss<double>& job, const LossBand& band, LossScratch<double>& scratch) {
  HWY_STATIC_DISPATCH(find_gradient)(job, band, scratch);
}

}  // namespace

int64_t photo_loss_partials(int64_t images, int64_t height_px, int64_t) { return images * height_px; }

template <class T>
void photo_loss(const PhotoLoss<T>& job, int threads) {
  const int64_t bands = (job.height_px + kLossBand - 1) / kLossBand, items = job.images * bands;
  std::vector<LossScratch<T>> scratch(std::min<int64_t>(threads, items), LossScratch<T>(job.row()));
  auto to_band = [&](int64_t item) {
    const int64_t first = item % bands * kLossBand;
    return LossBand{item / bands, first, std::min(first + kLossBand, job.height_px)};
  };
  parallel_for(items, threads, [&](int64_t item, int worker) { derivatives(job, to_band(item), scratch[worker]); });
  parallel_for(items, threads, [&](int64_t item, int worker) { gradient(job, to_band(item), scratch[worker]); });
  double sum = 0;
  for (int64_t line = 0; line < job.images * job.height_px; ++line) sum += job.partials[line];
  *job.loss = T(sum * job.sample_weight());
}

template void photo_loss<float>(const PhotoLoss<float>&, int);
template void photo_loss<double>(const PhotoLoss<double>&, int);

}  // namespace lfgs
#endif
