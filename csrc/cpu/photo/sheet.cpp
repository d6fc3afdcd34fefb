// The sheet over a photo, and the surface on which it lies. A work item has a row of texels, or a row of pixels of a
// layer or of a plane.
#include "base/parallel.h"
#include "math/photo/blur.h"
#include "stages/photo.h"

namespace lfgs {
namespace {

// Call visit(plane, row) for the rows of all planes.
template <class Visit>
void for_each_row(const Surface& job, int planes, int threads, const Visit& visit) {
  parallel_for(planes * job.height, threads,
               [&](int64_t item, int) { visit(int(item / job.height), item % job.height); });
}

// Blur planes of a set, by way of `between`, into a third set.
void blur_planes(const Surface& job, int planes, int from, int between, int to, int threads) {
  const BlurWeights weight(job.look.averaged);
  for_each_row(job, planes, threads, [&](int plane, int64_t row) {
    const float* in = job.plane(from, plane) + row * job.width;
    float* out = job.plane(between, plane) + row * job.width;
    for (int64_t x = 0; x < job.width; ++x) out[x] = blurred_at(in + x, 1, x, job.width, weight.reach(), weight);
  });
  for_each_row(job, planes, threads, [&](int plane, int64_t row) {
    const float* in = job.plane(between, plane) + row * job.width;
    float* out = job.plane(to, plane) + row * job.width;
    for (int64_t x = 0; x < job.width; ++x)
      out[x] = blurred_at(in + x, job.width, row, job.height, weight.reach(), weight);
  });
}

void store(const Sheet& job, int64_t row, int64_t column, const TexelGaussian& found) {
  const int64_t i = row * job.columns() + column;
  const int numbers = 3 * job.out.sh_count();
  for (int c = 0; c < 3; ++c) {
    job.out.means[3 * i + c] = found.mean[c];
    job.out.scales[3 * i + c] = found.scale[c];
    job.out.sh[numbers * i + c] = found.constant[c];
  }
  for (int c = 0; c < 4; ++c) job.out.quaternions[4 * i + c] = found.quaternion[c];
  job.out.opacities[i] = found.opacity;
  if (numbers > 3) store_harmonics(job, row, column);
}

}  // namespace

void surface(const Surface& job, int threads) {
  for_each_row(job, job.layers, threads, [&](int layer, int64_t row) {
    for (int64_t x = 0; x < job.width; ++x) weigh(job, layer, row * job.width + x);
  });
  blur_planes(job, job.fog_planes(), 0, 1, 2, threads);
  for_each_row(job, 1, threads, [&](int, int64_t row) {
    for (int64_t x = 0; x < job.width; ++x) look_through(job, row * job.width + x);
  });
  blur_planes(job, job.seen_planes(), 1, 2, 0, threads);
  for_each_row(job, 1, threads, [&](int, int64_t row) {
    for (int64_t x = 0; x < job.width; ++x) finish_surface(job, row * job.width + x);
  });
}

void sheet(const Sheet& job, int threads) {
  const BlurWeights weight(job.look.blur);
  parallel_for(job.rows(), threads, [&](int64_t row, int) {
    for (int64_t column = 0; column < job.columns(); ++column) prepare_texel(job, weight.reach(), weight, row, column);
  });
  snap_ramps(job, [&](const auto& pass) {
    parallel_for(job.rows(), threads, [&](int64_t row, int) {
      for (int64_t column = 0; column < job.columns(); ++column) pass(job, row, column);
    });
  });
  parallel_for(job.rows(), threads, [&](int64_t row, int) {
    for (int64_t column = 0; column < job.columns(); ++column)
      store(job, row, column, finish_texel(job, weight.reach(), weight, row, column));
  });
}

}  // namespace lfgs
