// Bind the stages of fitting: their buffers, and the stages of the CPU in both precisions.
#include <pybind11/pybind11.h>
#include <pybind11/stl.h>

#include <array>

#include "bind/bindings.h"
#include "stages/fit.h"
#ifdef LFGS_WITH_CUDA
#include "cuda/fit/fit.h"
#endif

namespace py = pybind11;

namespace lfgs {
namespace {

template <class T>
void bind_photo_loss(py::module_ m) {
  py::class_<PhotoLoss<T>>(m, "PhotoLoss")
      .def(py::init([](int64_t images, int64_t height_px, int64_t width_px, Address image, Address photo,
                       Address photo_bytes, Address weights, double ssim_lambda, Address derivatives, Address partials,
                       Address loss, Address gradient) {
             return PhotoLoss<T>{images,
                                 height_px,
                                 width_px,
                                 at<T>(image),
                                 at<T>(photo),
                                 at<uint8_t>(photo_bytes),
                                 at<float>(weights),
                                 ssim_lambda,
                                 at<T>(derivatives),
                                 at<double>(partials),
                                 at<T>(loss),
                                 at<T>(gradient)};
           }),
           py::kw_only(), py::arg("images"), py::arg("height_px"), py::arg("width_px"), py::arg("image"),
           py::arg("photo"), py::arg("photo_bytes"), py::arg("weights"), py::arg("ssim_lambda"), py::arg("derivatives"),
           py::arg("partials"), py::arg("loss"), py::arg("gradient"));
  m.def(
      "photo_loss", [](const PhotoLoss<T>& job, int threads) { photo_loss<T>(job, threads); }, NoGil(), py::arg("job"),
      py::arg("threads"));
}

template <class T>
void bind_update(py::module_ m) {
  py::class_<Parameters<T>>(m, "Parameters")
      .def(py::init([](Address means, Address log_scales, Address quaternions, Address logits, Address sh) {
             return Parameters<T>{at<T>(means), at<T>(log_scales), at<T>(quaternions), at<T>(logits), at<T>(sh)};
           }),
           py::arg("means"), py::arg("log_scales"), py::arg("quaternions"), py::arg("logits"), py::arg("sh"));
  py::class_<Update<T>>(m, "Update")
      .def(py::init([](const Gaussians<T>& gradients, const Parameters<T>& parameters, const Parameters<T>& first,
                       const Parameters<T>& second, Address scales, Address opacities, Address seen, Address table,
                       int64_t rows, Address step, Address skipped, double beta1, double beta2, double epsilon,
                       uint64_t seed) {
             return Update<T>{read_only(gradients),
                              parameters,
                              first,
                              second,
                              at<T>(scales),
                              at<T>(opacities),
                              at<uint8_t>(seen),
                              at<StepNumbers<T>>(table),
                              rows,
                              at<int64_t>(step),
                              at<int64_t>(skipped),
                              {beta1, beta2, epsilon},
                              seed};
           }),
           py::kw_only(), py::arg("gradients"), py::arg("parameters"), py::arg("first"), py::arg("second"),
           py::arg("scales"), py::arg("opacities"), py::arg("seen"), py::arg("table"), py::arg("rows"), py::arg("step"),
           py::arg("skipped"), py::arg("beta1"), py::arg("beta2"), py::arg("epsilon"), py::arg("seed"));
  m.def(
      "update", [](const Update<T>& job, int threads) { update<T>(job, threads); }, NoGil(), py::arg("job"),
      py::arg("threads"));
}

template <class T>
void bind_normals(py::module_ m) {
  m.def(
      "normals",
      [](uint64_t seed, uint32_t step, uint32_t purpose, int64_t count, Address out, int threads) {
        normals<T>({seed, step, purpose}, count, at<T>(out), threads);
      },
      NoGil(), py::arg("seed"), py::arg("step"), py::arg("purpose"), py::arg("count"), py::arg("out"),
      py::arg("threads"));
}

template <class T>
void bind_dropout(py::module_ m) {
  py::class_<Dropout<T>>(m, "Dropout")
      .def(py::init([](Address rates, int64_t rows, Address step, uint64_t seed, int64_t count, Address factors) {
             return Dropout<T>{at<T>(rates), rows, at<int64_t>(step), seed, count, at<T>(factors)};
           }),
           py::kw_only(), py::arg("rates"), py::arg("rows"), py::arg("step"), py::arg("seed"), py::arg("count"),
           py::arg("factors"));
  m.def(
      "dropout", [](const Dropout<T>& job, int threads) { dropout<T>(job, threads); }, NoGil(), py::arg("job"),
      py::arg("threads"));
}

template <class T>
void bind_fit_stages(py::module_ m) {
  bind_photo_loss<T>(m);
  bind_update<T>(m);
  bind_normals<T>(m);
  bind_dropout<T>(m);
}

std::array<uint32_t, 4> philox_words(const std::array<uint32_t, 4>& counter, const std::array<uint32_t, 2>& key) {
  const Words4 words = philox4x32({counter[0], counter[1], counter[2], counter[3]}, key[0], key[1]);
  return {words.x0, words.x1, words.x2, words.x3};
}

}  // namespace

void bind_fit(py::module_ root) {
  root.attr("STEP_COLUMNS") = kStepColumns;
  root.attr("NOISE_PURPOSE") = kNoisePurpose;
  root.attr("DROPOUT_PURPOSE") = kDropoutPurpose;
  root.attr("MOST_LOG_SCALE") = kMostLogScale;
  root.attr("MOST_LOGIT") = kMostLogit;
  root.def(
      "photo_loss_partials",
      [](int64_t images, int64_t height_px, int64_t width_px) {
        return photo_loss_partials(images, height_px, width_px);
      },
      py::arg("images"), py::arg("height_px"), py::arg("width_px"));
  root.def("philox4x32", &philox_words, py::arg("counter"), py::arg("key"));
  root.def(
      "uniforms",
      [](uint64_t seed, uint32_t step, uint32_t purpose, int64_t count, Address out, int threads) {
        uniforms({seed, step, purpose}, count, at<double>(out), threads);
      },
      NoGil(), py::arg("seed"), py::arg("step"), py::arg("purpose"), py::arg("count"), py::arg("out"),
      py::arg("threads"));
  bind_fit_stages<float>(root.attr("float32"));
  bind_fit_stages<double>(root.attr("float64"));
}

#ifdef LFGS_WITH_CUDA
void bind_fit_cuda(py::module_ cuda) {
  cuda.def("photo_loss_partials", &cuda::photo_loss_partials, py::arg("images"), py::arg("height_px"),
           py::arg("width_px"));
  cuda.def(
      "photo_loss", [](const PhotoLoss<float>& job, Address stream) { cuda::photo_loss(job, at<void>(stream)); },
      NoGil(), py::arg("job"), py::arg("stream"));
  cuda.def(
      "update", [](const Update<float>& job, Address stream) { cuda::update(job, at<void>(stream)); }, NoGil(),
      py::arg("job"), py::arg("stream"));
  cuda.def(
      "uniforms",
      [](uint64_t seed, uint32_t step, uint32_t purpose, int64_t count, Address out, Address stream) {
        cuda::uniforms({seed, step, purpose}, count, at<double>(out), at<void>(stream));
      },
      NoGil(), py::arg("seed"), py::arg("step"), py::arg("purpose"), py::arg("count"), py::arg("out"),
      py::arg("stream"));
  cuda.def(
      "normals",
      [](uint64_t seed, uint32_t step, uint32_t purpose, int64_t count, Address out, Address stream) {
        cuda::normals({seed, step, purpose}, count, at<float>(out), at<void>(stream));
      },
      NoGil(), py::arg("seed"), py::arg("step"), py::arg("purpose"), py::arg("count"), py::arg("out"),
      py::arg("stream"));
  cuda.def(
      "dropout", [](const Dropout<float>& job, Address stream) { cuda::dropout(job, at<void>(stream)); }, NoGil(),
      py::arg("job"), py::arg("stream"));
}
#endif

}  // namespace lfgs
