// Stage project for ordinary images, and its backward pass. It projects Gaussians by cameras to splats with colours.
// The backward pass takes the gradients of intersections to the gradients of Gaussians and cameras.
#include <algorithm>
#include <vector>

#include "base/parallel.h"
#include "cpu/gaussian_io.h"
#include "math/harmonics.h"
#include "stages/stages.h"

namespace lfgs {

using glm::dvec3;

template <class T>
void project_images(const Gaussians<const T>& gaussians, const Cameras<T>& cameras, const Splats<T>& out, int threads) {
  const int64_t n = gaussians.count, chunks = (n + kGrain - 1) / kGrain;
  parallel_for(cameras.images() * chunks, threads, [&](int64_t item, int) {
    const int64_t image = item / chunks, begin = item % chunks * kGrain, end = std::min(n, begin + kGrain);
    const Gaussians<const T> scene = gaussians.slice(image / cameras.per_scene * n);
    const Camera<double> camera = cameras.camera(image);
    const bool rolling = cameras.rolls();
    const dvec3 centre = camera.centre();
    for (int64_t i = begin; i < end; ++i) {
      const Shape<double> shape = load_shape<double>(scene, i);
      Compensation<double> unused;
      Splat<double> splat = projected(camera, shape, unused);
      cull_outside(splat, cameras.width_px, cameras.height_px);
      out.splats[image * n + i] = splat_cast<T>(splat);
      T* stored = out.colours + (image * n + i) * kColourStride;
      std::fill_n(stored, kColourStride, T(0));
      if (splat.reach_y < 0) continue;
      const dvec3 eye = rolling ? eye_of(camera, shape.mean) : centre;
      const dvec3 colour = sh_colour<double>(scene.sh_degree, scene.sh + 3 * scene.sh_count() * i, shape.mean, eye);
      for (int c = 0; c < 3; ++c) stored[c] = T(std::max(0.0, colour[c]));
    }
  });
}

template <class T>
void project_images_backward(const Gaussians<const T>& gaussians, const Cameras<T>& cameras, const Splats<T>& splats,
                             const int64_t* first_intersection, const T* intersection_gradients,
                             const Gaussians<T>& out, T* screen, bool absolute, T* g_world_to_camera, T* g_optics,
                             int threads) {
  const int64_t n = gaussians.count, chunks = (n + kGrain - 1) / kGrain;
  const int size = image_intersection_gradient_size(absolute), screen_numbers = absolute ? 4 : 2;
  struct ViewGradient {
    CameraGradient<double> camera;
    MotionGradient<double> motion;
    OpticsGradient<double> optics;
  };
  std::vector<ViewGradient> partial(cameras.images() * chunks);

  // A work item is a chunk of one scene's Gaussians, and takes the cameras of the scene in order. What it adds to a
  // camera's gradient is kept by chunk, so that the sum does not depend on the threads.
  parallel_for(cameras.scenes * chunks, threads, [&](int64_t item, int) {
    const int64_t b = item / chunks, begin = item % chunks * kGrain, end = std::min(n, begin + kGrain);
    const Gaussians<const T> scene = gaussians.slice(b * n);
    const Gaussians<T> g_scene = out.slice(b * n);
    std::vector<double> sum(size);
    const IntersectionGradient<double> g_intersection{sum.data()};
    std::vector<Shape<double>> over_views(end - begin, Shape<double>{dvec3(0), glm::dvec4(0), dvec3(0), 0});
    for (int64_t v = 0; v < cameras.per_scene; ++v) {
      const int64_t image = b * cameras.per_scene + v;
      const Camera<double> camera = cameras.camera(image);
      const bool rolling = cameras.rolls();
      const dvec3 centre = camera.centre();
      auto& [g_camera, g_motion, of_optics] = partial[image * chunks + item % chunks];
      OpticsGradient<double>* g_of_optics = g_optics ? &of_optics : nullptr;
      dvec3 g_centre(0);
      for (int64_t i = begin; i < end; ++i) {
        const Splat<T>& splat = splats.splats[image * n + i];
        T* place = screen ? screen + (image * n + i) * screen_numbers : nullptr;
        if (place) std::fill_n(place, screen_numbers, T(0));
        if (splat.reach_y < 0) continue;
        if (first_intersection)
          sum_intersections(splat, cameras.height_px, first_intersection[image * n + i], size, intersection_gradients,
                            sum.data());
        else
          read_sums(intersection_gradients + (image * n + i) * kSplatSums, absolute, g_intersection);

        // Colours, through their clamp at zero
        const Shape<double> shape = load_shape<double>(scene, i);
        const dvec3 eye = rolling ? eye_of(camera, shape.mean) : centre;
        Shape<double>& g = over_views[i - begin];
        const T* colour = splats.colours + (image * n + i) * kColourStride;
        dvec3 g_colour(0);
        for (int c = 0; c < 3; ++c) g_colour[c] = colour[c] > 0 ? g_intersection.colours()[c] : 0.0;
        const int64_t k = 3 * scene.sh_count() * i;
        const dvec3 g_mean =
            sh_colour_backward(scene.sh_degree, scene.sh + k, shape.mean, eye, g_colour, g_scene.sh + k);
        g.mean += g_mean;
        g_centre -= g_mean;

        // From the splat to the Gaussian and the camera
        const Splat<double>& g_splat = g_intersection.splat();
        projected_backward(camera, shape, g_splat, -g_mean, g, g_camera, g_motion, g_of_optics);

        if (place) place[0] = saturated<T>(g_splat.u0), place[1] = saturated<T>(g_splat.v0);
        for (int k = 2; place && k < screen_numbers; ++k) place[k] = saturated<T>(g_intersection.absolute()[k - 2]);
      }
      if (rolling) continue;
      // The eye is the centre, -R^T t
      g_camera.rotation += glm::outerProduct(-camera.translation, g_centre);
      g_camera.translation -= camera.rotation * g_centre;
    }
    for (int64_t i = begin; i < end; ++i) add_gradient(load_shape<double>(scene, i), over_views[i - begin], g_scene, i);
  });

  // Gradients of the cameras, summed over chunks
  for (int64_t image = 0; image < cameras.images(); ++image) {
    ViewGradient g;
    for (int64_t c = 0; c < chunks; ++c) {
      const auto& [camera, motion, optics] = partial[image * chunks + c];
      g.camera.rotation += camera.rotation, g.camera.translation += camera.translation;
      g.motion.turn += motion.turn, g.motion.way += motion.way;
      g.optics += optics;
    }
    T* m = g_world_to_camera + cameras.pose_numbers() * image;
    for (int row = 0; row < 3; ++row) {
      for (int col = 0; col < 3; ++col) m[4 * row + col] = T(g.camera.rotation[col][row]);
      m[4 * row + 3] = T(g.camera.translation[row]);
    }
    for (int k = 0; g_optics && k < kCameraOptics; ++k) g_optics[kCameraOptics * image + k] = T(g.optics.numbers[k]);
    if (!cameras.rolls()) continue;
    for (int k = 0; k < 3; ++k) m[16 + k] = T(g.motion.turn[k]), m[20 + k] = T(g.motion.way[k]);
  }
}

template <class T>
void sum_intersections(const Splats<T>& splats, int64_t height_px, const int64_t* first_intersection,
                       const T* intersection_gradients, bool absolute, T* sums, int threads) {
  const int64_t all = splats.images * splats.count, size = image_intersection_gradient_size(absolute);
  parallel_for((all + kGrain - 1) / kGrain, threads, [&](int64_t item, int) {
    std::vector<double> sum(size);
    for (int64_t i = item * kGrain; i < std::min(all, (item + 1) * kGrain); ++i) {
      sum_intersections(splats.splats[i], height_px, first_intersection[i], int(size), intersection_gradients,
                        sum.data());
      write_sums(IntersectionGradient<double>{sum.data()}, absolute, sums + i * kSplatSums);
    }
  });
}

#define LFGS_INSTANTIATE(T)                                                                             \
  template void sum_intersections(const Splats<T>&, int64_t, const int64_t*, const T*, bool, T*, int);  \
  template void project_images(const Gaussians<const T>&, const Cameras<T>&, const Splats<T>&, int);    \
  template void project_images_backward(const Gaussians<const T>&, const Cameras<T>&, const Splats<T>&, \
                                        const int64_t*, const T*, const Gaussians<T>&, T*, bool, T*, T*, int);
LFGS_INSTANTIATE(float)
LFGS_INSTANTIATE(double)

}  // namespace lfgs
