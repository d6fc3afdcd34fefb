# What compilers are told: GCC and Clang, and on Windows MSVC or clang-cl, which takes MSVC's options.
set(LFGS_SANITIZE "" CACHE STRING "Sanitizers to compile in: address,undefined or thread (empty: none)")

if(NOT LFGS_MARCH)
  set(LFGS_MARCH x86-64-v2)  # a toolchain may have a name of its own for it
endif()

# ccache keeps what was compiled before. Of a precompiled header it sees the file, not the time of it.
find_program(LFGS_CCACHE ccache)
if(LFGS_CCACHE AND NOT CMAKE_CXX_COMPILER_LAUNCHER)
  set(CMAKE_CXX_COMPILER_LAUNCHER ${CMAKE_COMMAND} -E env CCACHE_SLOPPINESS=pch_defines,time_macros ${LFGS_CCACHE})
  set(CMAKE_CUDA_COMPILER_LAUNCHER ${LFGS_CCACHE})
endif()

function(lfgs_compile target)
  # Vector sets of Highway that are not compiled. Structures hold vectors, and those of SVE have no size to be held by:
  # ARM processors that have it use NEON. A build with sanitizers has vectors of one width, to build in a minute.
  set(disabled "HWY_SVE|HWY_SVE2|HWY_SVE_256|HWY_SVE2_128")
  if(LFGS_SANITIZE)
    string(APPEND disabled "|HWY_SSSE3|HWY_SSE4|HWY_AVX3")
  endif()
  # Without AES, which no stage uses, SSE4 is the set that every processor has, and SSSE3 is not compiled beside it
  target_compile_definitions(${target} PRIVATE "HWY_DISABLED_TARGETS=(${disabled})" HWY_DISABLE_PCLMUL_AES)
  if(MSVC)
    # /bigobj: Highway's variants of a file have more sections than an object file has by default
    target_compile_options(${target} PRIVATE $<$<COMPILE_LANGUAGE:CXX>:/W3 /utf-8 /bigobj /permissive-
      /Zc:__cplusplus>)
    return()
  endif()
  target_compile_options(${target} PRIVATE $<$<COMPILE_LANGUAGE:CXX>:-Wall -Wextra -fno-math-errno>)
  if(CMAKE_SYSTEM_PROCESSOR MATCHES "x86_64|AMD64")
    # Every x86-64 processor since 2009; wider vectors are chosen at run time
    target_compile_options(${target} PRIVATE $<$<COMPILE_LANGUAGE:CXX>:-march=${LFGS_MARCH}>)
  else()
    # These processors can multiply and add in one rounding, which x86-64-v2 cannot: scalar code is to round as there,
    # and alike wherever a function is inlined. Vector code asks for it by name.
    target_compile_options(${target} PRIVATE $<$<COMPILE_LANGUAGE:CXX>:-ffp-contract=off>)
  endif()
endfunction()
