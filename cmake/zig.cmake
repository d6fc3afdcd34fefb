# For Zig's cross compiler (the package `ziglang`): LFGS_ZIG is the Python that has it, LFGS_TARGET one of
# x86_64-windows-gnu, aarch64-windows-gnu and aarch64-macos. It is Clang, with the headers and libraries of these systems.
set(CMAKE_TRY_COMPILE_PLATFORM_VARIABLES LFGS_ZIG LFGS_TARGET)
string(REPLACE "-" ";" parts ${LFGS_TARGET})
list(GET parts 0 CMAKE_SYSTEM_PROCESSOR)
list(GET parts 1 system)
set(systems_windows Windows)
set(systems_macos Darwin)
set(CMAKE_SYSTEM_NAME ${systems_${system}})
set(CMAKE_C_COMPILER ${LFGS_ZIG} -m ziglang cc -target ${LFGS_TARGET})  # CMake asks for it where Highway is fetched
set(CMAKE_CXX_COMPILER ${LFGS_ZIG} -m ziglang c++ -target ${LFGS_TARGET})
set(CMAKE_TRY_COMPILE_CONFIGURATION Release)  # Zig compiles its C++ library once for each configuration
set(CMAKE_CXX_ARCHIVE_CREATE "${LFGS_ZIG} -m ziglang ar qcs <TARGET> <OBJECTS>")  # that of Linux knows no Mach-O
set(CMAKE_CXX_ARCHIVE_APPEND "${LFGS_ZIG} -m ziglang ar qs <TARGET> <OBJECTS>")
set(CMAKE_CXX_ARCHIVE_FINISH "")
# Tools of Apple and Microsoft, which only libraries and installed programs need
set(CMAKE_INSTALL_NAME_TOOL ${CMAKE_COMMAND})
set(CMAKE_RC_COMPILER ${CMAKE_COMMAND})
set(LFGS_MARCH x86_64_v2)  # as Zig writes x86-64-v2
set(LFGS_CCACHE OFF)  # it keeps what it compiled itself
