# Builds that look for mistakes: AddressSanitizer and UndefinedBehaviorSanitizer in the module, or ThreadSanitizer in
# stages_on_threads.
set(LFGS_SANITIZE "" CACHE STRING "Sanitizers to compile in: address,undefined or thread (empty: none)")

if(LFGS_SANITIZE)
  # Vectors of one width, to build in a minute; in the module the same once more as scalar code. Highway leaves that
  # out with GCC before 12.3, for a fault in its vectorizer; without that pass it is right
  target_compile_definitions(_core PRIVATE HWY_COMPILE_ALL_ATTAINABLE HWY_BROKEN_EMU128=0
    "HWY_DISABLED_TARGETS=(HWY_SSSE3|HWY_SSE4|HWY_AVX3)")
  target_compile_options(_core PRIVATE $<$<COMPILE_LANGUAGE:CXX>:-fno-tree-vectorize>)
  foreach(target _core plain_stages stages_on_threads)
    target_compile_options(${target} PRIVATE -O1 -g1 -fsanitize=${LFGS_SANITIZE} -fno-sanitize-recover=all
      -fno-omit-frame-pointer $<$<STREQUAL:${CMAKE_SYSTEM_PROCESSOR},x86_64>:-march=x86-64-v3>)
    target_link_options(${target} PRIVATE -fsanitize=${LFGS_SANITIZE})
  endforeach()
endif()
