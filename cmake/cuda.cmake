# The CUDA stages: AUTO builds them for a GPU that answers or for architectures that are given, ON insists, OFF leaves
# them out. The runtime is linked statically, so that the module loads on machines without a driver.
set(LFGS_CUDA AUTO CACHE STRING "CUDA backend: AUTO, ON or OFF")
set(LFGS_CUDA_ARCHITECTURES "" CACHE STRING
  "CUDA architectures, 75..120, several as 75;86;89;90;120 (empty: the GPU of this machine, else 90)")

if(LFGS_CUDA STREQUAL "OFF")
  return()
endif()
execute_process(COMMAND nvidia-smi -L RESULT_VARIABLE no_gpu OUTPUT_QUIET ERROR_QUIET)
if(LFGS_CUDA STREQUAL "AUTO" AND no_gpu AND NOT LFGS_CUDA_ARCHITECTURES)
  message(STATUS "No GPU answers (nvidia-smi -L): building for the CPU only; LFGS_CUDA=ON builds for both")
  return()
endif()
include(CheckLanguage)
check_language(CUDA)
if(NOT CMAKE_CUDA_COMPILER)
  if(LFGS_CUDA STREQUAL "ON")
    message(FATAL_ERROR "LFGS_CUDA=ON, but no CUDA compiler was found: put nvcc on PATH, or set LFGS_CUDA=OFF")
  endif()
  message(STATUS "No CUDA compiler: building for the CPU only")
  return()
endif()

set(architectures ${LFGS_CUDA_ARCHITECTURES})
if(NOT architectures)
  if(no_gpu)
    set(architectures 90)
  else()
    set(architectures native)
  endif()
endif()
# Of numbers, each is machine code, and the newest PTX as well, for devices that are newer than all
string(REGEX MATCHALL "[0-9]+" numbers "${architectures}")
if("${numbers}" STREQUAL "${architectures}")
  list(SORT numbers COMPARE NATURAL)
  list(GET numbers -1 newest)
  list(TRANSFORM numbers APPEND "-real" OUTPUT_VARIABLE architectures)
  list(APPEND architectures "${newest}-virtual")
endif()
set(CMAKE_CUDA_ARCHITECTURES ${architectures})
enable_language(CUDA)
set_target_properties(_core PROPERTIES
  CUDA_ARCHITECTURES "${architectures}" CUDA_STANDARD 20 CUDA_STANDARD_REQUIRED ON CUDA_RUNTIME_LIBRARY Static)

target_sources(bindings PRIVATE
  csrc/bind/cuda.cpp
  csrc/bind/frame.cpp)
target_compile_definitions(bindings PRIVATE LFGS_WITH_CUDA)
target_include_directories(bindings PRIVATE ${CMAKE_CUDA_TOOLKIT_INCLUDE_DIRECTORIES})
target_sources(_core PRIVATE
  csrc/cuda/stages/architectures.cu
  csrc/cuda/stages/bin.cu
  csrc/cuda/image/composite_features.cu
  csrc/cuda/image/composite_images.cu
  csrc/cuda/image/project_images.cu
  csrc/cuda/image/project_images_backward.cu
  csrc/cuda/image/sum_intersections.cu
  csrc/cuda/fit/photo_loss.cu
  csrc/cuda/fit/random.cu
  csrc/cuda/fit/update.cu
  csrc/cuda/direct/composite_direct.cu
  csrc/cuda/direct/project_direct.cu
  csrc/cuda/direct/project_direct_backward.cu
  csrc/cuda/photo/crop.cu
  csrc/cuda/photo/sheet.cu
  csrc/cuda/png/deflate.cu
  csrc/cuda/sorted/bin_sorted.cu
  csrc/cuda/sorted/composite_sorted.cu
  csrc/cuda/sorted/project_sorted.cu
  csrc/cuda/frame/bin_frame.cu
  csrc/cuda/frame/direct_frame.cu
  csrc/cuda/frame/project_frame.cu
  csrc/cuda/frame/lattice/composite_lattice.cu
  csrc/cuda/frame/lens_column/composite_lens_column.cu
  csrc/cuda/frame/pixel/composite_pixel.cu
  csrc/network/group_norm.cu)
# GLM's calls can otherwise vanish from device code with only a warning (20011..20015); 20012 is noise of GLM itself
target_compile_options(_core PRIVATE $<$<COMPILE_LANGUAGE:CUDA>:--expt-relaxed-constexpr
  --diag-error=20011,20013,20014,20015 --diag-suppress=20012>)
