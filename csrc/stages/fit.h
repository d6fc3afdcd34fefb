// The stages of fitting a scene to photographs, on the CPU. Every buffer belongs to the caller; T is float or double.
#pragma once

#include <cstdint>

#include "math/fit/photo_loss.h"
#include "math/fit/random.h"
#include "math/fit/update.h"

namespace lfgs {

// --- The loss and its gradient. photo_loss_partials: how many partial sums it keeps.
int64_t photo_loss_partials(int64_t views, int64_t height_px, int64_t width_px);
template <class T>
void photo_loss(const PhotoLoss<T>& job, int threads);

// --- The step of the optimiser.
template <class T>
void update(const Update<T>& job, int threads);

// --- Random numbers: in [0, 1), two for each index of the stream; and normal ones, four for each.
void uniforms(const RandomStream& stream, int64_t count, double* out, int threads);
template <class T>
void normals(const RandomStream& stream, int64_t count, T* out, int threads);
template <class T>
void dropout(const Dropout<T>& job, int threads);

}  // namespace lfgs
