// The compensation of a splat within a lens column, sqrt(D(s) / S(s)) in math/compensation.h. Exact intersections
// evaluate it by the formula, all others as a parabola.
#pragma once

#include "cuda/common/halves.cuh"
#include "cuda/frame/root_series.cuh"

namespace lfgs::cuda {

// The largest error of log2 of the compensation for which a parabola is good enough: alpha is off by less than 0.1/255.
constexpr float kMostCompensationError = 5e-4f;

// The compensation c as a function of v, with s1 and s2 of LensColumnShape.
//   c^2 = (e0 + e1 v + e2 v^2) / (1 + s1 v + s2 v^2)
struct LensColumnCompensation {
  float e0 = 1, e1 = 0, e2 = 0;

  LensColumnCompensation() = default;
  // centre and unit are the arguments that the shape was made with.
  __device__ LensColumnCompensation(const Compensation<float>& c, const LensColumnShape& shape, float centre,
                                    float unit) {
    const float inverse = shape.r * shape.r;
    e0 = fmaxf(fmaf(centre, fmaf(centre, c.D2, c.D1), c.D0), 0.f) * inverse;
    e1 = fmaf(2 * centre, c.D2, c.D1) * unit * inverse, e2 = c.D2 * unit * unit * inverse;
  }
  // The compensation that another lane of the warp has. All lanes call this.
  __device__ LensColumnCompensation of_lane(int lane) const {
    LensColumnCompensation out;
    out.e0 = __shfl_sync(~0u, e0, lane), out.e1 = __shfl_sync(~0u, e1, lane), out.e2 = __shfl_sync(~0u, e2, lane);
    return out;
  }
  // Log2 of the compensation at v, where inverse_square is 1 / (1 + s1 v + s2 v^2).
  __device__ float log2_at(float v, float inverse_square) const {
    return 0.5f * log2f(fmaxf(fmaf(v, fmaf(v, e2, e1), e0), 0.f) * inverse_square);
  }
};

// Log2 of the compensation as level + slope v + bend v^2; level is NaN where that is too coarse. The coefficients come
// from
//   log(1 + a v + b v^2) = a v + (b - a^2 / 2) v^2 + (a^3 / 3 - a b) v^3 - (a^4 / 4 - a^2 b + b^2 / 2) v^4 ...
// for the numerator, less the same series for the denominator. The next two terms give the error.
struct CompensationFit {
  float level, slope, bend;

  __device__ CompensationFit(const LensColumnCompensation& compensation, const LensColumnShape& shape,
                             const LensColumns& lens_columns) {
    constexpr float kUnit = float(kHalfLog2e);  // 1 / (2 ln 2)
    const float a = compensation.e1 / compensation.e0, b = compensation.e2 / compensation.e0, s = shape.s1,
                t = shape.s2, reach = lens_columns.reach;
    auto square = [](float p, float q) { return q - 0.5f * p * p; };
    auto cube = [](float p, float q) { return p * (p * p * (1 / 3.f) - q); };
    auto fourth = [](float p, float q) { return p * p * (q - 0.25f * p * p) - 0.5f * q * q; };
    const float third = kUnit * (cube(a, b) - cube(s, t)), last = kUnit * (fourth(a, b) - fourth(s, t));
    const float error = reach * reach * reach * (0.4f * fabsf(third) + 0.5f * reach * fabsf(last));
    // The series is wrong where S varies much, so such splats are too coarse whatever the error
    const float most = reach * fmaxf(fabsf(a) + reach * fabsf(b), fabsf(s) + reach * fabsf(t));
    level = error <= kMostCompensationError && most <= 0.5f ? 0.5f * log2f(compensation.e0) : NAN;
    slope = fmaf(lens_columns.cubic, third, kUnit * (a - s)), bend = kUnit * (square(a, b) - square(s, t));
  }
};

}  // namespace lfgs::cuda
