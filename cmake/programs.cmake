# The stages without Python: for ThreadSanitizer, which would watch all of Python and torch as well (stages_on_threads),
# and for processors that are emulated (stages_to_file). Built only where they are asked for, with the vectors that
# every processor of the kind has.
add_library(plain_stages OBJECT EXCLUDE_FROM_ALL ${cpu_stages})
add_executable(stages_on_threads EXCLUDE_FROM_ALL tests/native/stages_on_threads.cpp)
add_executable(stages_to_file EXCLUDE_FROM_ALL tests/native/stages_to_file.cpp)
foreach(target plain_stages stages_on_threads stages_to_file)
  target_include_directories(${target} PRIVATE csrc tests)
  target_link_libraries(${target} PRIVATE glm::glm hwy::hwy Threads::Threads)
  target_compile_definitions(${target} PRIVATE GLM_FORCE_XYZW_ONLY HWY_COMPILE_ONLY_STATIC)
  lfgs_compile(${target})
endforeach()
target_link_libraries(stages_on_threads PRIVATE plain_stages)
target_link_libraries(stages_to_file PRIVATE plain_stages)
