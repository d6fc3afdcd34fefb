// A step of the optimiser: Adam for one number, the buffers of the step, and the update of one Gaussian. Harmonics are
// updated apart, because they are many and all alike.
#pragma once

#include "base/config.h"
#include <cstdint>
#include <cmath>

#include "scene/gaussians.h"
#include "math/covariance.h"
#include "math/fit/random.h"

namespace lfgs {

// Constants of all steps of Adam (Kingma & Ba, "Adam: a method for stochastic optimization", ICLR 2015, algorithm 1).
struct AdamDecay {
  double first = 0.9, second = 0.999;  // beta1, beta2
  double epsilon = 1e-15;              // added to the root of the second moment
};

// The numbers of one step that do not depend on the field. With c1 = 1 - beta1^t and c2 = 1 - beta2^t a number moves by
// -(rate / c1) m / (sqrt(v / c2) + epsilon).
template <class R>
struct AdamStep {
  R keep_first, take_first, keep_second, take_second;  // beta1, 1 - beta1, beta2, 1 - beta2
  R epsilon, inverse_root_correction, inverse_correction;

  LFGS_HD AdamStep(const AdamDecay& decay, R first_correction, R second_correction)
      : keep_first(R(decay.first)),
        take_first(R(1 - decay.first)),
        keep_second(R(decay.second)),
        take_second(R(1 - decay.second)),
        epsilon(R(decay.epsilon)),
        inverse_root_correction(1 / std::sqrt(second_correction)),
        inverse_correction(1 / first_correction) {}

  // Move a number against its gradient, and renew its moments. rate_over_c1: the rate of its field times
  // inverse_correction.
  LFGS_HD R moved(R value, R gradient, R rate_over_c1, R& first, R& second) const {
    first = keep_first * first + take_first * gradient;
    second = keep_second * second + take_second * gradient * gradient;
    return value - rate_over_c1 * first / (std::sqrt(second) * inverse_root_correction + epsilon);
  }
};

// Gradients that are no numbers, or so large that their square is none in float32, would spoil the moments for good.
template <class R>
LFGS_HD bool is_usable(R gradient) {
  return std::abs(gradient) <= R(1e18);  // false for NaN
}

// exp(-20) .. exp(20) is 2e-9 .. 5e8 scene units: beyond what float32 tells from zero beside a mean of 1, and beyond
// any scene.
constexpr double kMostLogScale = 20;
// sigmoid(15) = 1 - 3e-7 is the largest that float32 still tells from 1 by a few steps: log(1 - opacity) stays finite.
constexpr double kMostLogit = 15;

template <class R>
LFGS_HD R clamped(R value, R most) {
  return value > most ? most : value < -most ? -most : value;
}

// 0 for very negative values, without overflow on the way.
template <class R>
LFGS_HD R sigmoid(R value) {
  return 1 / (1 + std::exp(-clamped(value, R(80))));
}

constexpr double kNoiseSteepness = 100, kNoiseOpacity = 0.005;

// Sigma z sigmoid(100 (0.005 - opacity)) strength, for normal z. The quaternion has any length but zero; of a Gaussian
// whose quaternion is zero the noise is zero, for it has no directions.
template <class R>
LFGS_HD glm::vec<3, R> position_noise(const RandomStream& stream, uint64_t index, glm::vec<4, R> quaternion,
                                      const glm::vec<3, R>& scale, R opacity, R strength) {
  R z[4];
  normals4(stream, index, z);
  const R length = std::sqrt(glm::dot(quaternion, quaternion));
  if (!(length > 0)) return glm::vec<3, R>(0);
  const glm::mat<3, 3, R> axes = rotation_matrix(quaternion / length);
  glm::vec<3, R> along = glm::vec<3, R>(z[0], z[1], z[2]) * axes;  // components along the axes of the Gaussian
  along *= scale * scale * (strength * sigmoid(R(kNoiseSteepness) * (R(kNoiseOpacity) - opacity)));
  return axes * along;
}

// The parameters that are optimised, or their moments: log_scales and logits stand for scales and opacities.
template <class T>
struct Parameters {
  T* means = nullptr;        // [N, 3]
  T* log_scales = nullptr;   // [N, 3]
  T* quaternions = nullptr;  // [N, 4] wxyz of any length
  T* logits = nullptr;       // [N]
  T* sh = nullptr;           // [N, K, 3]
};

// The inputs of one step: a row of the table of a run.
template <class T>
struct StepNumbers {
  T means, log_scales, quaternions, logits, sh_dc, sh_rest;  // rates
  T first_correction, second_correction;                     // 1 - beta1^t, 1 - beta2^t
  T noise_lr;                                                // of the noise of positions, times the rate of means
  T opacity_reg, scale_reg;                                  // of the mean opacity and the mean scale in the loss
};
constexpr int kStepColumns = sizeof(StepNumbers<float>) / sizeof(float);

// Gradients go through the chain rule of exp and sigmoid, and the regularisers are added. Adam moves the parameters,
// noise moves the means, and the activated scales and opacities are written anew. Of Gaussians with a gradient that
// is_usable() refuses nothing changes, and they are counted. So are all, where `step` is not a row of the table.
template <class T>
struct Update {
  Gaussians<const T> gradients;  // of the drawn Gaussians; count and degree as of all parameters
  Parameters<T> parameters, first, second;
  T* scales = nullptr;                    // [N, 3] exp(log_scales), at which the gradients were taken; written anew
  T* opacities = nullptr;                 // [N] sigmoid(logits), likewise
  const uint8_t* seen = nullptr;          // [N] whom the regularisers are for, or null for all
  const StepNumbers<T>* table = nullptr;  // [rows]
  int64_t rows = 0;
  const int64_t* step = nullptr;  // one number in 0..rows-1, the row; also the step of the noise
  int64_t* skipped = nullptr;     // one number, added to
  AdamDecay decay;
  uint64_t seed = 0;  // of the noise

  LFGS_HD int64_t count() const { return gradients.count; }
  LFGS_HD int numbers() const { return 3 * gradients.sh_count(); }  // harmonics of a Gaussian
  LFGS_HD bool has_row() const { return *step >= 0 && *step < rows; }
};

// The numbers of the step that an update is at.
template <class R>
struct Step {
  StepNumbers<R> numbers;
  AdamStep<R> adam;
  R opacity_push, scale_push;  // added by the regularisers to the gradient of an opacity, of a scale
  RandomStream noise;

  LFGS_HD explicit Step(const Update<R>& job)
      : numbers(job.table[*job.step]),
        adam(job.decay, numbers.first_correction, numbers.second_correction),
        opacity_push(numbers.opacity_reg / R(job.count())),
        scale_push(numbers.scale_reg / R(3 * job.count())),
        noise{job.seed, uint32_t(*job.step), kNoisePurpose} {}

  LFGS_HD R scaled(R rate) const { return rate * adam.inverse_correction; }
  // Of the k-th harmonic of a Gaussian
  LFGS_HD R sh_rate(int k) const { return scaled(k < 3 ? numbers.sh_dc : numbers.sh_rest); }
};

// Gradients of one Gaussian's parameters, but for its harmonics.
template <class R>
struct ParameterGradients {
  R means[3], log_scales[3], quaternions[4], logit;

  ParameterGradients() = default;
  LFGS_HD ParameterGradients(const Update<R>& job, const Step<R>& step, int64_t i) {
    const Gaussians<const R>& g = job.gradients;
    const bool pushed = !job.seen || job.seen[i];
    for (int c = 0; c < 3; ++c) {
      means[c] = g.means[3 * i + c];
      log_scales[c] = (g.scales[3 * i + c] + (pushed ? step.scale_push : R(0))) * job.scales[3 * i + c];
    }
    for (int c = 0; c < 4; ++c) quaternions[c] = g.quaternions[4 * i + c];
    const R opacity = job.opacities[i];
    logit = (g.opacities[i] + (pushed ? step.opacity_push : R(0))) * opacity * (1 - opacity);
  }

  LFGS_HD bool usable() const {
    bool good = is_usable(logit);
    for (int c = 0; c < 3; ++c) good = good && is_usable(means[c]) && is_usable(log_scales[c]);
    for (int c = 0; c < 4; ++c) good = good && is_usable(quaternions[c]);
    return good;
  }
};

// Move `size` numbers of Gaussian i that share a rate.
template <int size, class R>
LFGS_HD void move_numbers(const AdamStep<R>& adam, const R (&gradient)[size], R rate, int64_t i, R* values, R* first,
                          R* second) {
  for (int c = 0; c < size; ++c) {
    const int64_t k = size * i + c;
    values[k] = adam.moved(values[k], gradient[c], rate, first[k], second[k]);
  }
}

// All of the step for one Gaussian but its harmonics.
template <class R>
LFGS_HD void move_gaussian(const Update<R>& job, const Step<R>& step, const ParameterGradients<R>& g, int64_t i) {
  const Parameters<R>&parameters = job.parameters, &first = job.first, &second = job.second;
  const StepNumbers<R>& n = step.numbers;
  move_numbers(step.adam, g.means, step.scaled(n.means), i, parameters.means, first.means, second.means);
  move_numbers(step.adam, g.log_scales, step.scaled(n.log_scales), i, parameters.log_scales, first.log_scales,
               second.log_scales);
  move_numbers(step.adam, g.quaternions, step.scaled(n.quaternions), i, parameters.quaternions, first.quaternions,
               second.quaternions);
  const R logit =
      step.adam.moved(parameters.logits[i], g.logit, step.scaled(n.logits), first.logits[i], second.logits[i]);
  parameters.logits[i] = clamped(logit, R(kMostLogit));

  glm::vec<3, R> scale;
  for (int c = 0; c < 3; ++c) {
    R& log_scale = parameters.log_scales[3 * i + c];
    log_scale = clamped(log_scale, R(kMostLogScale));
    job.scales[3 * i + c] = scale[c] = std::exp(log_scale);
  }
  const R opacity = job.opacities[i] = sigmoid(parameters.logits[i]);
  if (n.noise_lr > 0) {
    const R* q = parameters.quaternions + 4 * i;
    const glm::vec<3, R> noise =
        position_noise(step.noise, i, glm::vec<4, R>(q[0], q[1], q[2], q[3]), scale, opacity, n.noise_lr * n.means);
    for (int c = 0; c < 3; ++c) parameters.means[3 * i + c] += noise[c];
  }
}

}  // namespace lfgs
