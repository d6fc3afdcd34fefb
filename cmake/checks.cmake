# Builds that look for mistakes: sanitizers, and the vector code once more without vectors.
set(LFGS_SANITIZE "" CACHE STRING "Sanitizers to compile in: address,undefined or thread (empty: none)")
option(LFGS_SCALAR "Also compile the vector code as scalar code, EMU128 among build_info()['simd_targets']" OFF)

if(LFGS_SCALAR)
  # Highway leaves EMU128 out with GCC before 12.3, for a fault in its vectorizer; without that pass it is right
  target_compile_definitions(_core PRIVATE HWY_COMPILE_ALL_ATTAINABLE HWY_BROKEN_EMU128=0)
  target_compile_options(_core PRIVATE $<$<COMPILE_LANGUAGE:CXX>:-fno-tree-vectorize>)
endif()
if(LFGS_SANITIZE)
  set(sanitizers -fsanitize=${LFGS_SANITIZE} -fno-sanitize-recover=all -fno-omit-frame-pointer -g1)
  target_compile_options(_core PRIVATE $<$<COMPILE_LANGUAGE:CXX>:${sanitizers}>)
  target_link_options(_core PRIVATE -fsanitize=${LFGS_SANITIZE})
endif()
