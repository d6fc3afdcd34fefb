# What compilers are told: GCC and Clang, and on Windows MSVC or clang-cl, which takes MSVC's options.

# Vector sets of Highway that are not compiled. Structures hold vectors, and those of SVE have no size to be held by:
# ARM processors that have it use NEON.
set(LFGS_DISABLED_TARGETS "HWY_SVE|HWY_SVE2|HWY_SVE_256|HWY_SVE2_128")
function(lfgs_compile target)
  target_compile_definitions(${target} PRIVATE "HWY_DISABLED_TARGETS=(${LFGS_DISABLED_TARGETS})")
  if(MSVC)
    # /bigobj: Highway's variants of a file have more sections than an object file has by default
    target_compile_options(${target} PRIVATE $<$<COMPILE_LANGUAGE:CXX>:/W3 /utf-8 /bigobj /permissive-
      /Zc:__cplusplus>)
    return()
  endif()
  target_compile_options(${target} PRIVATE $<$<COMPILE_LANGUAGE:CXX>:-Wall -Wextra -fno-math-errno>)
  if(CMAKE_SYSTEM_PROCESSOR MATCHES "x86_64|AMD64")
    # Every x86-64 processor since 2009; wider vectors are chosen at run time
    target_compile_options(${target} PRIVATE $<$<COMPILE_LANGUAGE:CXX>:-march=x86-64-v2>)
  else()
    # These processors can multiply and add in one rounding, which x86-64-v2 cannot: scalar code is to round as there,
    # and alike wherever a function is inlined. Vector code asks for it by name.
    target_compile_options(${target} PRIVATE $<$<COMPILE_LANGUAGE:CXX>:-ffp-contract=off>)
  endif()
endfunction()
