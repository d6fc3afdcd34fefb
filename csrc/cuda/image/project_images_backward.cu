// Backward pass of stage project for ordinary images on the device. It reads the sums over all splats' intersections.
// It writes the gradients of the Gaussians, of the cameras and, on request, of the splats' places on the screen. A
// thread has a Gaussian of a scene, and visits the cameras of the scene in order. A block sums the gradients of each
// camera over its Gaussians. Splats and colours are computed once more, so that nothing of the forward has to be kept
// for this.
//
// Harmonics are four fifths of the bytes read and written. A thread's own lie far from its neighbours', so each warp
// moves the harmonics of its 32 Gaussians together, through shared memory.
#include <type_traits>

#include "cuda/common/blend.cuh"
#include "cuda/common/launch.h"
#include "cuda/common/gaussian_io.cuh"
#include "cuda/stages/projection.cuh"
#include "cuda/stages/stages.h"
#include "math/gradient_sums.h"
#include "math/harmonics.h"
#include "math/saturate.h"

namespace lfgs::cuda {
namespace {

using glm::vec3;
constexpr int kThreads = 128, kWarps = kThreads / 32;

// The output of sum_intersections(), for all splats.
struct AllSums {
  const float* sums;
  bool absolute;  // whether there are absolute gradients
};

// The numbers of a splat's intersections, added up; the last two are 0 unless there are absolute gradients.
struct SplatSums {
  float numbers[kSplatSums];

  __device__ static SplatSums of(const AllSums& all, int64_t splat) {
    static_assert(kSplatSums % 4 == 0);
    SplatSums out;
#pragma unroll
    for (int f = 0; f < kSplatSums / 4; ++f) {
      const float4 four = __ldg(reinterpret_cast<const float4*>(all.sums + splat * kSplatSums) + f);
      out.numbers[4 * f] = four.x, out.numbers[4 * f + 1] = four.y;
      out.numbers[4 * f + 2] = four.z, out.numbers[4 * f + 3] = four.w;
    }
    if (!all.absolute) out.numbers[kAbsoluteSum] = out.numbers[kAbsoluteSum + 1] = 0;
    return out;
  }

  // Whether any is not zero; else nothing follows from them.
  __device__ bool any() const {
    bool found = false;
#pragma unroll
    for (int f = 0; f < kSplatSums; ++f) found |= !(numbers[f] == 0);
    return found;
  }
};

// Turn the sums of a splat's intersections into the gradients of the splat and of its colour.
template <class R>
__device__ Splat<R> splat_gradient(const Splat<float>& s, const SplatSums& sums, vec3& colour) {
  R sum[kImageSums];
  for (int f = 0; f < kImageSums; ++f) sum[f] = R(sums.numbers[f]);
  Splat<R> g = image_gradient(s, sum);
  g.depth = sum[kDepthSum];
  colour = vec3(sum[kColourSum], sum[kColourSum + 1], sum[kColourSum + 2]);
  return g;
}

// Whether a splat is so long and thin that its covariance has few digits left in float. The measure is
// rho^2 / (1 - rho^2), where rho is the correlation of x and y.
__device__ bool is_needle(const Splat<float>& s) {
  constexpr float kLong = 300;
  return !(s.c0 * s.c0 <= kLong * s.tau * s.S0);
}

// The gradients of a Gaussian and of a camera so far, and of a splat's colour and its centre on the screen.
struct Gradients {
  Shape<float> shape{vec3(0), glm::vec4(0), vec3(0), 0};
  CameraGradient<float> camera;
  vec3 colour;
  float2 place;

  static constexpr int kCameraNumbers = 12;
  __device__ float camera_number(int k) const {
    return k % 4 == 3 ? camera.translation[k / 4] : camera.rotation[k % 4][k / 4];
  }
};

// Before a rolling shutter also those of its motion, and of where the camera stands when it reads the Gaussian.
struct RollingGradients : Gradients {
  MotionGradient<float> motion;
  vec3 eye;

  static constexpr int kCameraNumbers = 12 + 6;
  __device__ float camera_number(int k) const {
    return k < 12 ? Gradients::camera_number(k) : k < 15 ? motion.turn[k - 12] : motion.way[k - 15];
  }
};

// Either with those of the camera's optics behind.
template <class G>
struct WithOptics : G {
  OpticsGradient<float> optics;

  static constexpr int kPoseNumbers = G::kCameraNumbers, kCameraNumbers = kPoseNumbers + kCameraOptics;
  __device__ float camera_number(int k) const {
    return k < kPoseNumbers ? G::camera_number(k) : optics.numbers[k - kPoseNumbers];
  }
};

template <class G>
constexpr bool kRolling = std::is_base_of_v<RollingGradients, G>;
template <class G>
constexpr bool kOptics = false;
template <class G>
constexpr bool kOptics<WithOptics<G>> = true;

// Where the gradients of optics are added up, or null.
template <class G>
__device__ OpticsGradient<float>* optics_of(G& g) {
  if constexpr (kOptics<G>)
    return &g.optics;
  else
    return nullptr;
}

// Return `so_far` plus the gradients of the projection of Gaussian `i` of a scene into an image. They are computed in
// double and then rounded. It is not inlined, since it is rarely called and takes many registers; kCurved is for
// cameras that are no pinholes, so that these take none from the others. It reads everything once more, and gradients
// go in and out by value: addresses would force them into memory for ordinary splats too.
template <bool kCompensated, bool kCurved, class G>
__device__ __noinline__ G with_exact_backward(const Gaussians<const float>& gaussians, const Cameras<float>& cameras,
                                              const AllSums& sums, int64_t image, int64_t i, G so_far) {
  const int64_t n = gaussians.count;
  const Shape<float> shape = load_shape<float>(gaussians.slice(image / cameras.per_scene * n), i);
  const Camera<double> exact = cameras.camera<double>(image);
  const Shape<double> wide = widened(shape);
  using Projected = std::conditional_t<kCurved, CurvedProjection<double, kRolling<G>>, Projection<double>>;
  const Projected projection(exact, wide);

  // The gradient of the splat, which is computed once more as it was drawn
  Splat<float> splat;
  if constexpr (kCurved) {
    splat = splat_cast<float>(projection.splat(wide.opacity));
  } else if constexpr (kCompensated) {
    Compensation<float> of_one_camera;
    splat = compensated_splat(exact, shape, of_one_camera);
  } else {
    splat = projected<Way::kFast>(cameras, image, cameras.camera<float>(image), shape);
  }
  vec3 colour;  // already in so_far before a rolling shutter
  Splat<double> gradient = splat_gradient<double>(splat, SplatSums::of(sums, image * n + i), colour);
  if constexpr (!kRolling<G>) so_far.colour = colour;
  so_far.place = make_float2(float(gradient.u0), float(gradient.v0));
  Shape<double> sum{glm::dvec3(0), glm::dvec4(0), glm::dvec3(0), 0};
  CameraGradient<double> of_camera;
  [[maybe_unused]] OpticsGradient<double> of_optics;
  OpticsGradient<double>* const optics_out = kOptics<G> ? &of_optics : nullptr;

  // The backward pass, in double
  [[maybe_unused]] MotionGradient<double> of_motion;
  if constexpr (kCurved) {
    glm::dvec3 g_eye(0);
    if constexpr (kRolling<G>) g_eye = so_far.eye;
    projection.backward(exact, wide, gradient, g_eye, sum, of_camera, of_motion, optics_out);
  } else {
    Compensation<double> g_D{};
    if (kCompensated) g_D = projection.compensate_backward(exact, gradient);
    projection.template backward<kCompensated>(exact, wide, gradient, sum, of_camera, g_D, optics_out);
  }

  // Add it to the gradients of other cameras
  Shape<float>& g = so_far.shape;
  auto add = [](float& to, double what) { to = saturated<float>(to + what); };
  for (int c = 0; c < 3; ++c) add(g.mean[c], sum.mean[c]), add(g.scale[c], sum.scale[c]);
  for (int c = 0; c < 4; ++c) add(g.quaternion[c], sum.quaternion[c]);
  add(g.opacity, sum.opacity);
  for (int c = 0; c < 3; ++c) {
    add(so_far.camera.translation[c], of_camera.translation[c]);
    for (int r = 0; r < 3; ++r) add(so_far.camera.rotation[c][r], of_camera.rotation[c][r]);
    if constexpr (kRolling<G>) {
      add(so_far.motion.turn[c], of_motion.turn[c]);
      add(so_far.motion.way[c], of_motion.way[c]);
    }
  }
  if constexpr (kOptics<G>)
    for (int k = 0; k < kCameraOptics; ++k) add(so_far.optics.numbers[k], of_optics.numbers[k]);
  return so_far;
}

// The harmonics of a warp's Gaussians in shared memory, a row each. Rows are of odd length, so that lanes that read the
// same column of their rows use different banks. Lanes move four numbers at a time.
struct HarmonicRows {
  float* rows;
  int numbers;

  static __host__ __device__ constexpr int padded(int numbers) { return numbers | 1; }
  __device__ float* own() const { return rows + int(threadIdx.x % 32) * padded(numbers); }

  // Read the rows whose bits are set in `which`; `from` is the first of 32 in memory.
  __device__ void load(const float* from, unsigned which) const {
    with_numbers([&]<int kNumbers>() {
      float4 fours[kFours<kNumbers>];
#pragma unroll
      for (int k = 0; k < kFours<kNumbers>; ++k)
        if (const int at = first_of_four<kNumbers>(k); at >= 0 && any_of_four<kNumbers>(which, at))
          fours[k] = __ldg(reinterpret_cast<const float4*>(from + at));
#pragma unroll
      for (int k = 0; k < kFours<kNumbers>; ++k)
        if (const int at = first_of_four<kNumbers>(k); at >= 0)
          for (int j = 0; j < 4; ++j) rows[place<kNumbers>(at + j)] = (&fours[k].x)[j];
    });
    __syncwarp();
  }

  // The same where there are fewer than 32 rows, or rows that are not aligned to four numbers.
  __device__ void load_one_by_one(const float* from, unsigned which) const {
    for (int row = 0; row < 32; ++row)
      if (which >> row & 1)
        for (int k = threadIdx.x % 32; k < numbers; k += 32) rows[row * padded(numbers) + k] = from[row * numbers + k];
    __syncwarp();
  }

  // Set all rows to zero.
  __device__ void clear() const {
    for (int k = threadIdx.x % 32; k < 32 * padded(numbers); k += 32) rows[k] = 0;
    __syncwarp();
  }

  // Write 32 rows, zero where the bit is not set.
  __device__ void store(float* to, unsigned which) const {
    __syncwarp();
    with_numbers([&]<int kNumbers>() {
#pragma unroll
      for (int k = 0; k < kFours<kNumbers>; ++k)
        if (const int at = first_of_four<kNumbers>(k); at >= 0) {
          float4 four;
          for (int j = 0; j < 4; ++j)
            (&four.x)[j] = which >> ((at + j) / kNumbers) & 1 ? rows[place<kNumbers>(at + j)] : 0.f;
          *reinterpret_cast<float4*>(to + at) = four;
        }
    });
  }

  // The same for `count` rows, aligned or not.
  __device__ void store_one_by_one(float* to, unsigned which, int count) const {
    __syncwarp();
    for (int row = 0; row < count; ++row)
      for (int k = threadIdx.x % 32; k < numbers; k += 32)
        to[row * numbers + k] = which >> row & 1 ? rows[row * padded(numbers) + k] : 0.f;
  }

 private:
  template <int kNumbers>
  static constexpr int kFours = (kNumbers + 3) / 4;  // that a lane moves

  // Call with the numbers of a row as a template's argument.
  template <class Call>
  __device__ void with_numbers(const Call& call) const {
    switch (numbers) {
      case 3:
        return call.template operator()<3>();
      case 12:
        return call.template operator()<12>();
      case 27:
        return call.template operator()<27>();
      default:
        return call.template operator()<48>();
    }
  }

  // Where in memory the k-th four of this lane begins, or -1: the last lanes have none where kNumbers is odd.
  template <int kNumbers>
  static __device__ int first_of_four(int k) {
    const int at = 4 * (int(threadIdx.x % 32) + 32 * k);
    return kNumbers % 4 == 0 || at < 32 * kNumbers ? at : -1;
  }
  template <int kNumbers>
  static __device__ bool any_of_four(unsigned which, int at) {
    return (which >> (at / kNumbers) | which >> ((at + 3) / kNumbers)) & 1;
  }
  template <int kNumbers>
  static __device__ int place(int at) {
    return at / kNumbers * padded(kNumbers) + at % kNumbers;
  }
};

// Whether Gaussian `i` of a scene has a gradient from any of its cameras.
__device__ bool is_lit(const AllSums& sums, const Cameras<float>& cameras, int64_t scene, int64_t n, int64_t i) {
  bool lit = false;
  for (int64_t v = 0; v < cameras.per_scene; ++v)
    lit |= SplatSums::of(sums, (scene * cameras.per_scene + v) * n + i).any();
  return lit;
}

// Write the gradient of a splat's centre, and with `absolute` the absolute gradients behind it.
__device__ void store_place(float2 gradient, const SplatSums& sums, bool absolute, float* screen, int64_t index) {
  if (absolute) {
    const float* others = sums.numbers + kAbsoluteSum;
    reinterpret_cast<float4*>(screen)[index] = make_float4(gradient.x, gradient.y, others[0], others[1]);
  } else {
    reinterpret_cast<float2*>(screen)[index] = gradient;
  }
}

// Write all gradients. The backward pass of an ordinary splat fits the registers that three blocks on a multiprocessor
// leave, or four without the gradients of cameras (kCameras). Needles go through with_exact_backward() instead, and
// with kExact (see Cameras::exact) all do. kOneCamera: there is one camera a scene, so that the gradients of harmonics
// can overwrite the harmonics. G is RollingGradients before rolling shutters, and WithOptics where the gradients of
// optics are asked for.
template <bool kExact, bool kOneCamera, bool kCameras, class G = Gradients>
__global__ void __launch_bounds__(kThreads, kOptics<G> ? 2
                                            : kCameras ? 3
                                                       : 4)
    project_images_backward_kernel(const __grid_constant__ Gaussians<const float> gaussians,
                                   const __grid_constant__ Cameras<float> cameras, const __grid_constant__ AllSums sums,
                                   Gaussians<float> out, float* screen, float* camera_partials) {
  __shared__ float partial[kWarps][G::kCameraNumbers];
  extern __shared__ float harmonics[];
  const int64_t i = int64_t(blockIdx.x) * kThreads + threadIdx.x, scene = blockIdx.y, n = gaussians.count;
  const bool real = i < n;
  const Gaussians<const float> own = gaussians.slice(scene * n);
  const Gaussians<float> g_own = out.slice(scene * n);
  const Shape<float> shape = load_shape<float>(own, real ? i : 0);
  G g;

  // Load the harmonics of Gaussians that have a gradient, and clear memory for their gradients
  const int numbers = 3 * own.sh_count(), warp_floats = 32 * HarmonicRows::padded(numbers);
  const int64_t first = i - threadIdx.x % 32;  // Gaussian of this warp
  const unsigned lit = __ballot_sync(~0u, real && is_lit(sums, cameras, scene, n, i));
  const HarmonicRows rows{harmonics + threadIdx.x / 32 * warp_floats, numbers};
  const HarmonicRows g_rows{kOneCamera ? rows.rows : rows.rows + kWarps * warp_floats, numbers};
  const float* sh = own.sh + numbers * first;
  float* g_sh = g_own.sh + numbers * first;
  const bool in_fours = first + 32 <= n && reinterpret_cast<uintptr_t>(sh) % sizeof(float4) == 0 &&
                        reinterpret_cast<uintptr_t>(g_sh) % sizeof(float4) == 0;
  in_fours ? rows.load(sh, lit) : rows.load_one_by_one(sh, lit);
  if (!kOneCamera) g_rows.clear();

  const int64_t own_cameras = kOneCamera ? 1 : cameras.per_scene;
  for (int64_t v = 0; v < own_cameras; ++v) {
    const int64_t image = scene * cameras.per_scene + v;
    const Camera<float> camera = cameras.camera<float>(image);
    const int64_t index = image * n + i;
    const SplatSums of_splat = real ? SplatSums::of(sums, index) : SplatSums{};
    g.camera = {}, g.place = make_float2(0, 0);
    if constexpr (kOptics<G>) g.optics = {};

    // The colour, through its clamp at zero; returns its gradient by the mean, which is less that by the eye
    const auto colour_backward = [&](const vec3& eye) {
      const vec3 colour = sh_colour<float>(own.sh_degree, rows.own(), shape.mean, eye);
      for (int c = 0; c < 3; ++c) g.colour[c] = colour[c] > 0 ? g.colour[c] : 0.f;
      const vec3 g_mean =
          sh_colour_backward<!kOneCamera>(own.sh_degree, rows.own(), shape.mean, eye, g.colour, g_rows.own());
      g.shape.mean += g_mean;
      return g_mean;
    };

    if constexpr (kRolling<G>) {
      g.motion = {};
      if (of_splat.any()) {
        for (int c = 0; c < 3; ++c) g.colour[c] = of_splat.numbers[kColourSum + c];
        g.eye = -colour_backward(eye_of<Way::kRolling>(cameras, image, camera, shape.mean));
        g = with_exact_backward<false, true>(gaussians, cameras, sums, image, i, g);
      }
    } else if (of_splat.any()) {
      const Projection<float> projection(camera, shape);
      const Splat<float> splat = projection.splat(camera, shape.opacity);
      if (kExact || is_needle(splat)) {
        g = kExact && cameras.model != CameraModel::kPinhole
                ? with_exact_backward<false, true>(gaussians, cameras, sums, image, i, g)
                : with_exact_backward<kExact, false>(gaussians, cameras, sums, image, i, g);
      } else {
        const Splat<float> g_splat = splat_gradient<float>(splat, of_splat, g.colour);
        projection.backward(camera, shape, g_splat, g.shape, g.camera, {}, optics_of(g));
        g.place = make_float2(g_splat.u0, g_splat.v0);
      }
      const vec3 g_mean = colour_backward(camera.centre());
      if constexpr (kCameras) {  // the eye is -R^T t
        g.camera.rotation += glm::outerProduct(-camera.translation, -g_mean);
        g.camera.translation += camera.rotation * g_mean;
      }
    }
    if (screen && real) store_place(g.place, of_splat, sums.absolute, screen, index);
    if constexpr (kCameras)
      store_block_sums([&](int k) { return g.camera_number(k); }, partial,
                       camera_partials + (image * gridDim.x + blockIdx.x) * G::kCameraNumbers);
  }
  if (real) store_gradient(shape, g.shape, g_own, i);
  in_fours ? g_rows.store(g_sh, lit) : g_rows.store_one_by_one(g_sh, lit, int(min(int64_t(32), n - first)));
}

using Kernel = decltype(&project_images_backward_kernel<false, true, false>);

template <bool kExact, class G>
Kernel select_kernel(bool one_camera, bool cameras, bool optics) {
  if (optics)
    return one_camera ? project_images_backward_kernel<kExact, true, true, WithOptics<G>>
                      : project_images_backward_kernel<kExact, false, true, WithOptics<G>>;
  if (one_camera)
    return cameras ? project_images_backward_kernel<kExact, true, true, G>
                   : project_images_backward_kernel<kExact, true, false, G>;
  return cameras ? project_images_backward_kernel<kExact, false, true, G>
                 : project_images_backward_kernel<kExact, false, false, G>;
}

}  // namespace

int64_t camera_blocks(int64_t gaussians) { return blocks_for(gaussians, kThreads); }

void project_images_backward(const Gaussians<const float>& gaussians, const Cameras<float>& cameras, const float* sums,
                             const Gaussians<float>& out, float* screen, bool absolute, float* camera_partials,
                             bool optics, Stream stream) {
  if (gaussians.count == 0 || cameras.scenes == 0) return;
  const dim3 blocks(unsigned(camera_blocks(gaussians.count)), unsigned(cameras.scenes));
  const bool one = cameras.per_scene == 1, of_cameras = camera_partials;
  const Way way = way_of(cameras);
  const auto kernel = way == Way::kRolling ? select_kernel<true, RollingGradients>(one, of_cameras, optics)
                      : way == Way::kExact ? select_kernel<true, Gradients>(one, of_cameras, optics)
                                           : select_kernel<false, Gradients>(one, of_cameras, optics);
  const size_t bytes = size_t(one ? 1 : 2) * kThreads * HarmonicRows::padded(3 * gaussians.sh_count()) * sizeof(float);
  check(cudaFuncSetAttribute(kernel, cudaFuncAttributeMaxDynamicSharedMemorySize, int(bytes)),
        "project_images_backward: shared memory");
  kernel<<<blocks, kThreads, bytes, cudaStream_t(stream)>>>(gaussians, cameras, AllSums{sums, absolute}, out, screen,
                                                            camera_partials);
  check_launch("project_images_backward");
}

}  // namespace lfgs::cuda
