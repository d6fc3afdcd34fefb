// The sheet over a photo: a work item has a row of texels.
#include "base/parallel.h"
#include "math/photo/blur.h"
#include "stages/photo.h"

namespace lfgs {
namespace {

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

void sheet(const Sheet& job, int threads) {
  const BlurWeights weight(job.look.blur);
  parallel_for(job.rows(), threads, [&](int64_t row, int) {
    for (int64_t column = 0; column < job.columns(); ++column) prepare_texel(job, weight.reach(), weight, row, column);
  });
  parallel_for(job.rows(), threads, [&](int64_t row, int) {
    for (int64_t column = 0; column < job.columns(); ++column)
      store(job, row, column, finish_texel(job, weight.reach(), weight, row, column));
  });
}

}  // namespace lfgs
