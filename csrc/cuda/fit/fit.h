// The stages of fitting on a CUDA device: the same as the CPU's (stages/fit.h), with device pointers and a stream.
// Nothing allocates or waits, and nothing depends on values that the host would have to know: a CUDA graph can hold
// them.
#pragma once

#include <cstdint>

#include "cuda/stages/stages.h"
#include "math/fit/random.h"
#include "math/fit/photo_loss.h"
#include "math/fit/update.h"

namespace lfgs::cuda {

int64_t photo_loss_partials(int64_t images, int64_t height_px, int64_t width_px);
void photo_loss(const PhotoLoss<float>& job, Stream stream);

void update(const Update<float>& job, Stream stream);

void uniforms(const RandomStream& random, int64_t count, double* out, Stream stream);
void normals(const RandomStream& random, int64_t count, float* out, Stream stream);
void dropout(const Dropout<float>& job, Stream stream);

}  // namespace lfgs::cuda
