// A small scene through the CPU's stages, forward and backward, for every sensor and in both precisions. The programs
// beside this file compare what comes of it: on several threads, and on another processor.
#pragma once

#include <algorithm>
#include <cmath>
#include <random>
#include <string>
#include <utility>
#include <vector>

#include "stages/fit.h"
#include "stages/stages.h"
#include "stages/weave.h"

namespace lfgs {

inline constexpr int64_t kCount = 1500, kWidth = 150, kHeight = 70, kViews = 3;
inline constexpr double kPose[16] = {1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1}, kCamera[4] = {90, 90, 75, 35};
inline constexpr double kLimits[5] = {-1.5, 1.5, -1, 1, 0};
inline constexpr Quality kLattice{-5, 0.05, 0.5};

inline Lens make_lens(int64_t views, bool continuous) {
  const uint64_t step = uint64_t(18446744073709551615.0 / 9.85);
  return {kWidth, kHeight, views, step, step, step / 2, 9.85, 1.0 / 6, 1, false, continuous, 0.7, -1.4 / double(views),
          false,  {}};
}

template <class T>
struct Render {
  std::vector<T> means, quaternions, scales, opacities, sh, image, alpha, depth, gradient;
  std::vector<T> poses, cameras, limits;
  std::vector<T> colours, intersections, g_means, g_quaternions, g_scales, g_opacities, g_sh, g_pose, g_background;
  std::vector<T> g_optics, g_offsets;
  std::vector<double> g_rig;
  std::vector<Splat<T>> splats;
  std::vector<int32_t> orders, sorted, lists;
  std::vector<int64_t> drawn, offsets, first;
  const T background[3] = {T(0.2), T(0.4), T(0.6)};
  int threads;
  std::vector<std::pair<std::string, std::vector<T>>> results;  // what was drawn from what, by name

  explicit Render(int threads_) : threads(threads_) {
    std::mt19937 random(3);  // the same numbers by every library; a distribution of std has others in each
    auto fill = [&](std::vector<T>& values, int64_t n, double low, double high) {
      values.resize(size_t(n));
      for (T& v : values) v = T(low + (high - low) * std::ldexp(double(random()), -32));
    };
    fill(means, 3 * kCount, -0.8, 0.8), fill(quaternions, 4 * kCount, -1, 1), fill(scales, 3 * kCount, 0.005, 0.1);
    fill(opacities, kCount, 0.1, 1), fill(sh, 12 * kCount, -0.5, 0.5);
    for (int64_t i = 0; i < kCount; ++i) means[size_t(3 * i + 2)] += T(2);
    fill(gradient, 3 * kWidth * kHeight, -1, 1);
    for (int64_t i = 0; i < kViews; ++i) {
      poses.insert(poses.end(), kPose, kPose + 16), cameras.insert(cameras.end(), kCamera, kCamera + 4);
      limits.insert(limits.end(), kLimits, kLimits + 5);
      poses[size_t(16 * i + 3)] = T(i) / 10;
    }
    image.resize(3 * kWidth * kHeight), alpha.resize(kWidth * kHeight), depth.resize(kWidth * kHeight);
    g_means.resize(means.size()), g_quaternions.resize(quaternions.size()), g_scales.resize(scales.size());
    g_opacities.resize(opacities.size()), g_sh.resize(sh.size()), g_pose.resize(16);
    g_background.resize(size_t(3 * band_count(kHeight)));
    g_optics.resize(kCameraOptics), g_offsets.resize(image.size()), g_rig.resize(16 + kRigOptics);
  }

  Gaussians<const T> scene() const {
    return {kCount, 1, means.data(), quaternions.data(), scales.data(), opacities.data(), sh.data()};
  }
  Gaussians<T> gradients() {
    return {kCount, 1, g_means.data(), g_quaternions.data(), g_scales.data(), g_opacities.data(), g_sh.data()};
  }
  Cameras<T> views(int64_t count) const {
    return {1, count, kWidth, kHeight, poses.data(), cameras.data(), limits.data()};
  }
  Splats<T> buffers(int64_t images, int order) {
    const size_t n = size_t(images * kCount);
    for (auto* sums : {&g_means, &g_quaternions, &g_scales, &g_opacities, &g_sh, &g_pose, &g_background})
      std::fill(sums->begin(), sums->end(), T(0));  // the backward pass adds to them
    splats.resize(n), orders.resize(n), colours.assign(n * size_t((order + 1) * kColourStride), T(0));
    return {images, kCount, order, splats.data(), colours.data(), orders.data()};
  }

  Bins order_and_bin(const Splats<T>& s) {
    sorted.resize(splats.size()), drawn.resize(size_t(s.images));
    offsets.resize(size_t(s.images * band_count(kHeight) + 1));
    order<T>(s, sorted.data(), drawn.data(), threads);
    Bins bins{offsets.data(), nullptr};
    lists.resize(size_t(bin_count<T>(s, sorted.data(), drawn.data(), kHeight, bins, threads)));
    bins.band_splats = lists.data();
    bin_fill<T>(s, sorted.data(), drawn.data(), kHeight, bins, threads);
    first.resize(splats.size()), first_intersections<T>(s, kHeight, bins, first.data(), threads);
    intersections.assign(lists.size() * size_t(intersection_gradient_size(s.colour_order)), T(0));
    return bins;
  }

  void lens(const std::string& name, bool continuous, const Quality& quality) {
    const Lens panel = make_lens(24, continuous);
    Camera<double> rig = make_camera<double>(kPose, kCamera, kLimits);
    rig.sweep = panel.reach(), rig.inverse_zero_depth = 0.5;
    const Splats<T> s = buffers(1, sizeof(T) == 4 ? 8 : 16);  // as in the package
    project_direct<T>(scene(), rig, panel, quality, 5e-5, s, threads);
    const Bins bins = order_and_bin(s);
    composite_direct<T>(s, bins, panel, quality, background, image.data(), nullptr, threads);
    if (quality.ends_early()) return record(name + " image", image);
    composite_direct_backward<T>(s, bins, panel, background, image.data(), gradient.data(), first.data(),
                                 intersections.data(), g_background.data(), g_offsets.data(), threads);
    project_direct_backward<T>(scene(), rig, panel, s, first.data(), intersections.data(), gradients(), g_rig.data(),
                               threads);
    record(name + " g_offsets", g_offsets), record(name + " g_rig", std::vector<T>(g_rig.begin(), g_rig.end()));
    keep(name);
  }

  void dense() {
    const Cameras<T> cameras = views(1);
    const Splats<T> s = buffers(1, 0);
    project_images<T>(scene(), cameras, s, threads);
    const Bins bins = order_and_bin(s);
    composite_images<T>(s, bins, cameras, background, {image.data(), alpha.data(), depth.data()}, threads);
    composite_images_backward<T>(s, bins, cameras, background, {image.data(), alpha.data(), depth.data()},
                                 {gradient.data(), alpha.data(), depth.data()}, false, first.data(),
                                 intersections.data(), g_background.data(), threads);
    project_images_backward<T>(scene(), cameras, s, first.data(), intersections.data(), gradients(), nullptr, false,
                               g_pose.data(), g_optics.data(), threads);
    record("dense alpha", alpha), record("dense depth", depth), record("dense g_pose", g_pose);
    record("dense g_optics", g_optics);
    keep("dense");
  }

  void by_view() {
    const ViewMap map{kWidth, kHeight, kViews, nullptr, make_lens(kViews, false)};
    const SubpixelTile tile{50, 4};
    const int64_t tiles = tile.count(kWidth, kHeight);
    const std::vector<int32_t> places{0, 1, 2};
    std::vector<int32_t> counts(size_t(kViews * tiles));
    plan_sorted_count(map, tile, places.data(), kViews, counts.data(), threads);
    std::vector<int64_t> starts{0};
    for (int32_t n : counts)
      starts.push_back(starts.back() + (n + kSubpixelBlock - 1) / kSubpixelBlock * kSubpixelBlock);
    std::vector<uint16_t> codes(size_t(starts.back()));
    plan_sorted_fill(map, tile, places.data(), kViews, starts.data(), codes.data(), threads);
    const Splats<T> s = buffers(kViews, 0);
    project_images<T>(scene(), views(kViews), s, threads);
    const Bins bins = order_and_bin(s);
    composite_sorted<T>(s, bins, views(kViews), {tile, starts.data(), codes.data()}, background, image.data(), nullptr,
                        threads);
    record("sorted image", image);
  }

  // The loss of the last image against other numbers; a step along the last gradients, with noise; random numbers.
  void fit() {
    std::vector<T> photo(image.size()), weighted(image.size()), derivatives(3 * image.size()), found(1);
    for (size_t i = 0; i < photo.size(); ++i) photo[i] = T(0.5) + gradient[i] / 2;
    std::vector<double> partials(size_t(photo_loss_partials(1, kHeight, kWidth))), uniform(20000);
    PhotoLoss<T> loss{1, kHeight, kWidth, image.data(), photo.data()};
    loss.derivatives = derivatives.data(), loss.partials = partials.data();
    loss.loss = found.data(), loss.gradient = weighted.data();
    photo_loss<T>(loss, threads);

    std::vector<T> values(23 * kCount, T(-1)), first_moments(values.size()), second_moments(values.size());
    auto parameters_in = [](std::vector<T>& of) {
      T* at = of.data();
      return Parameters<T>{at, at + 3 * kCount, at + 6 * kCount, at + 10 * kCount, at + 11 * kCount};
    };
    const StepNumbers<T> row{T(0.01), T(0.01), T(0.01), T(0.01), T(0.01), T(0.01), T(0.1), T(0.001), 100, 1, 1};
    const int64_t step = 0;
    int64_t skipped = 0;
    Update<T> job;
    job.gradients = {kCount, 1, g_means.data(), g_quaternions.data(), g_scales.data(), g_opacities.data(), g_sh.data()};
    job.parameters = parameters_in(values), job.first = parameters_in(first_moments),
    job.second = parameters_in(second_moments);
    std::vector<T> drawn_scales(scales), drawn_opacities(opacities);
    job.scales = drawn_scales.data(), job.opacities = drawn_opacities.data();
    job.table = &row, job.rows = 1, job.step = &step, job.skipped = &skipped;
    update<T>(job, threads);

    std::vector<T> normal(20000);
    uniforms({7, 0, 1}, int64_t(uniform.size()), uniform.data(), threads);
    normals<T>({7, 0, 2}, int64_t(normal.size()), normal.data(), threads);
    record("fit uniforms", std::vector<T>(uniform.begin(), uniform.end())), record("fit normals", normal);
    record("fit loss", found), record("fit gradient", weighted), record("fit values", values);
    record("fit moments", second_moments), record("fit scales", drawn_scales);
    record("fit opacities", drawn_opacities);
  }

  // Three pictures, each sub-pixel averaging over the width of a view.
  void woven() {
    std::vector<float> pictures;
    for (int64_t view = 0; view < kViews; ++view)
      for (T number : gradient) pictures.push_back(0.5f + float(number) / float(2 + view));
    WeaveFan fan;
    fan.map = {kWidth, kHeight, 24, nullptr, make_lens(24, true)};
    fan.continuous = true, fan.views = kViews, fan.box = 1;
    std::vector<float> out(3 * kWidth * kHeight);
    weave<float>({pictures.data(), 0, kViews, kViews, kHeight, kWidth}, {}, fan, out.data(), threads);
    record("woven image", std::vector<T>(out.begin(), out.end()));
  }

  void record(const std::string& name, const std::vector<T>& numbers) { results.emplace_back(name, numbers); }

  // The image that was drawn last, and the gradients of its scene.
  void keep(const std::string& name) {
    record(name + " image", image), record(name + " g_means", g_means), record(name + " g_sh", g_sh);
    record(name + " g_quaternions", g_quaternions), record(name + " g_scales", g_scales);
    record(name + " g_opacities", g_opacities);
  }

  void run() {
    lens("steps", false, {}), lens("continuous", true, {}), dense(), by_view(), fit(), woven();
    if constexpr (sizeof(T) == 4) lens("lattice steps", false, kLattice), lens("lattice", true, kLattice);
  }
};

}  // namespace lfgs
