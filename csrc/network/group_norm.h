// Group normalisation of the network's feature maps, for inference.
#pragma once

#include <cstdint>

#include "cuda/stages/stages.h"

namespace lfgs::cuda {

// Maps with their channels side by side ("channels last"); an even number of channels in each group.
struct FeatureMaps {
  int64_t images, pixels;
  int channels, groups;
};

// out = silu(weight (in - mean) / sqrt(variance + eps) + bias), the mean and variance those of each image's group of
// channels (Wu & He, ECCV 2018, eq. 1 to 3). All in bfloat16, two in a word, and float between. out may be in.
void group_norm_silu(const FeatureMaps& maps, const uint32_t* in, const uint32_t* weight, const uint32_t* bias,
                     float eps, uint32_t* out, Stream stream);

}  // namespace lfgs::cuda
