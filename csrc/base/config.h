// Host/device qualifiers: one source of the mathematics for C++ and CUDA.
#pragma once

#include <cstdint>

#if defined(__CUDACC__)
#define LFGS_HD __host__ __device__ inline
#else
#define LFGS_HD inline
#endif
