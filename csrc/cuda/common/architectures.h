// What the device code of this build was compiled for.
#pragma once

#include <vector>

namespace lfgs::cuda {

// The architectures that the compiler was told, ascending, as CMake numbers them (75, 90, 120); where that was
// "native", the one it stood for.
std::vector<int> architectures();

}  // namespace lfgs::cuda
