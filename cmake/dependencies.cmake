# GLM and Highway: the system's (Debian: libglm-dev, libhwy-dev), else fetched at a pinned hash.
include(FetchContent)

find_package(glm CONFIG QUIET)
if(NOT TARGET glm::glm)
  message(STATUS "GLM not found on the system: fetching it")
  FetchContent_Declare(glm
    URL https://github.com/g-truc/glm/archive/refs/tags/1.0.1.tar.gz
    URL_HASH SHA256=9f3174561fd26904b23f0db5e560971cbf9b3cbda0b280f04d5c379d03bf234c)
  FetchContent_MakeAvailable(glm)
endif()

if(CMAKE_CROSSCOMPILING AND glm_FOUND)  # beside it lie headers of this system, which are not those of the other
  get_target_property(glm_folder glm::glm INTERFACE_INCLUDE_DIRECTORIES)
  file(MAKE_DIRECTORY ${CMAKE_BINARY_DIR}/headers)
  file(CREATE_LINK ${glm_folder}/glm ${CMAKE_BINARY_DIR}/headers/glm SYMBOLIC)
  set_target_properties(glm::glm PROPERTIES INTERFACE_INCLUDE_DIRECTORIES ${CMAKE_BINARY_DIR}/headers)
endif()

find_package(hwy CONFIG QUIET)
if(NOT TARGET hwy::hwy)
  message(STATUS "Highway not found on the system: fetching it")
  set(HWY_ENABLE_TESTS OFF)
  set(HWY_ENABLE_EXAMPLES OFF)
  set(HWY_ENABLE_CONTRIB OFF)
  set(HWY_ENABLE_INSTALL OFF)
  set(BUILD_SHARED_LIBS OFF)
  FetchContent_Declare(hwy
    URL https://github.com/google/highway/archive/refs/tags/1.2.0.tar.gz
    URL_HASH SHA256=7e0be78b8318e8bdbf6fa545d2ecb4c90f947df03f7aadc42c1967f019e63343)
  FetchContent_MakeAvailable(hwy)
  if(NOT TARGET hwy::hwy)
    add_library(hwy::hwy ALIAS hwy)
  endif()
endif()
