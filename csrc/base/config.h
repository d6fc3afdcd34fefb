// Qualifiers that let C++ and CUDA share one source of the mathematics.
#pragma once

#include <cstdint>

#if defined(__CUDACC__)
#define LFGS_HD __host__ __device__ inline
#define LFGS_UNROLL _Pragma("unroll")  // the next loop, whose numbers then stay in registers
#define LFGS_NO_UNROLL _Pragma("unroll 1")
#else
#define LFGS_HD inline
#define LFGS_UNROLL
#define LFGS_NO_UNROLL
#endif

// On the CPU: unrolls the next loop, over the taps of a window, so that the loop around it becomes vectors. Compilers
// that do not know the pragma decide for themselves.
#if defined(__GNUC__)
#define LFGS_UNROLL_TAPS _Pragma("GCC unroll 16")
#else
#define LFGS_UNROLL_TAPS
#endif
