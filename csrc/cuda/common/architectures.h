// What the device code of this build was compiled for.
#pragma once

#include <vector>

namespace lfgs::cuda {

// Architectures as CMake counts them (75, 90, 120), ascending: those that the compiler was told, "native" resolved.
std::vector<int> architectures();

}  // namespace lfgs::cuda
