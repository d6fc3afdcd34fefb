# A build that looks for mistakes: AddressSanitizer and UndefinedBehaviorSanitizer in the module, or ThreadSanitizer in
# stages_on_threads.
if(LFGS_SANITIZE)
  # In the module the stages once more as scalar code. Highway leaves that out with GCC before 12.3, for a fault in its
  # vectorizer; without that pass it is right
  foreach(target _core bindings)
    target_compile_definitions(${target} PRIVATE HWY_COMPILE_ALL_ATTAINABLE HWY_BROKEN_EMU128=0)
    target_compile_options(${target} PRIVATE $<$<COMPILE_LANGUAGE:CXX>:-fno-tree-vectorize>)
  endforeach()
  foreach(target _core bindings plain_stages stages_on_threads)
    target_compile_options(${target} PRIVATE -O1 -g1 -fsanitize=${LFGS_SANITIZE} -fno-sanitize-recover=all
      -fno-omit-frame-pointer $<$<STREQUAL:${CMAKE_SYSTEM_PROCESSOR},x86_64>:-march=x86-64-v3>)
    target_link_options(${target} PRIVATE -fsanitize=${LFGS_SANITIZE})
  endforeach()
endif()
