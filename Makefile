# Everything a fresh machine needs: `make demo` and `make test` set it up themselves.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
DEBIAN_PACKAGES := g++ cmake python3-venv libglm-dev libhwy-dev
VULKAN_PACKAGES := libvulkan1 mesa-vulkan-drivers
ARM_PACKAGES := g++-aarch64-linux-gnu qemu-user
WINE_PACKAGES := wine wine64
NATIVE_SOURCES := CMakeLists.txt $(shell find csrc cmake -type f)
PHOTO := lightfield_gs/data/cat.png
CAPTURE := lightfield_gs/data/banana

.PHONY: setup photo demo demo-fit test test-wheel test-cuda-emulated test-webgpu sanitize sanitize-all \
  sanitize-threads sanitized-module sanitize-cuda cuda-module stubs test-arm test-windows clang lint fuzz bench docs \
  clean FORCE

setup: $(VENV)/.installed

# What photographs of phones take: networks for depth and for cut-outs. They fetch their weights at first use.
photo: setup $(VENV)/.photo

# The best that there is, in a minute or two: the 8K light-field images of a photo of one object, of a scene that was
# fitted to photographs, and of one of these photographs with its depth; and what eyes 15 degrees to the left, in the
# middle and 15 degrees to the right see of them from 2 m.
DEMO_EYES := --eyes -536,536,3
BANANA_LOOK := --focus 4.1 --depth-amount 0.6 --zoom 1.5 --pan 0.02,-0.03
demo: setup
	mkdir -p demo
	$(BIN)/lightfield-gs encode $(PHOTO) -o demo/cat.png --preview demo/preview
	$(BIN)/lightfield-gs simulate demo/cat.png $(DEMO_EYES) -o demo/cat-eyes.png
	$(BIN)/lightfield-gs encode $(CAPTURE)/fitted.spz --rig $(CAPTURE)/fitted.rig.yaml $(BANANA_LOOK) \
	  -o demo/scene.png --preview demo/scene-preview --depth-report
	$(BIN)/lightfield-gs simulate demo/scene.png $(DEMO_EYES) -o demo/scene-eyes.png
	$(BIN)/lightfield-gs encode $(CAPTURE)/images/DSC_0426.jpg --depth $(CAPTURE)/DSC_0426.depth.npz \
	  --focus 0.45,0.55 --depth-amount 0.5 --zoom 1.1 --pan 0.08,-0.02 -o demo/depth.png --preview demo/depth-preview \
	  --depth-report
	$(BIN)/lightfield-gs simulate demo/depth.png $(DEMO_EYES) -o demo/depth-eyes.png
	@echo "demo/*-eyes.png: what eyes at -15, 0 and +15 degrees see of a photo of one object (cat), of a scene that was"
	@echo "fitted to photographs (scene), and of one photograph with its depth (depth); demo/preview, demo/scene-preview and"
	@echo "demo/depth-preview: look-around.html follows the mouse"

# A scene fitted to 14 photographs, for what the panel shows of it, and its image: two minutes on two cores. The centre
# camera is one with others to both sides, and a photograph between them is held out.
demo-fit: setup
	mkdir -p demo
	$(BIN)/lightfield-gs fit $(CAPTURE) -o demo/banana.ply --longest-px 376 --steps 1500 --gaussians 15000 --sh-degree 2 --init-scale 0.1 \
	  --cone 65in-8k-96v --centre DSC_0426.jpg --test-every 9 --device cpu
	$(BIN)/lightfield-gs encode demo/banana.ply -o demo/banana.png --rig demo/banana.rig.yaml $(BANANA_LOOK) \
	  --preview demo/banana-preview
	$(BIN)/lightfield-gs simulate demo/banana.png $(DEMO_EYES) -o demo/banana-eyes.png
	@echo "demo/banana.fit/last.png: a view that was held out, its photograph, and their difference; demo/banana.png: the"
	@echo "image for the panel; demo/banana-eyes.png: what eyes at -15, 0 and +15 degrees see of it;"
	@echo "demo/banana-preview/look-around.webp: what eyes see that move from left to right and back"

# The suite: tests side by side, one process a core and each on one thread, for a thread that waits for another would wait
# for the other processes as well; then, one by one, those that compare times. A file is in one process, for its tests
# share what takes long to make. Last, how many tests were skipped, and why.
PYTEST = OMP_NUM_THREADS=1 $(BIN)/python -m pytest -q
BESIDE := --numprocesses auto --maxprocesses 8 --dist loadfile --no-loadscope-reorder
SKIPPED := build/skipped

test: setup $(VENV)/.vulkan
	@mkdir -p build && rm -f $(SKIPPED)
	LFGS_SKIPPED=$(SKIPPED) $(PYTEST) $(BESIDE) -m "not alone and not wheel and not cuda_emulated and not webgpu_large" tests
	LFGS_SKIPPED=$(SKIPPED) $(PYTEST) -m alone tests
	@touch $(SKIPPED); echo "skipped: $$(sort $(SKIPPED) | uniq -c | sort -rn | sed 's/^ *//' | paste -sd';' | sed 's/;/; /g')"

# What compiles a module of its own. The wheel takes the objects of `make setup`.
test-wheel: setup
	$(PYTEST) -m wheel tests/house/test_wheel.py

test-cuda-emulated: setup
	$(PYTEST) $(BESIDE) -m cuda_emulated tests/cuda

# Frames by WebGPU that take minutes on Mesa's lavapipe: a panel of 16K, millions of Gaussians, long lists.
test-webgpu: setup $(VENV)/.vulkan
	$(PYTEST) -m webgpu_large tests/webgpu

# The native module under AddressSanitizer and UndefinedBehaviorSanitizer, vectors and scalar code; and the stages on
# several threads under ThreadSanitizer. `sanitize` runs the files that call each native stage, with a quarter of the
# stress cases, another one for each commit; `sanitize-all`, before a release, all tests that reach the module (those
# without the marker not_sanitized). --capture=sys, or pytest keeps to itself what a sanitizer says at the end.
SANITIZED := tests/rasterizer tests/encoding tests/io/test_stress_images.py tests/io/test_stress_invalid.py \
  tests/models/test_detail.py tests/models/test_sheet.py \
  $(foreach name,dropout morton photo_loss random optimizer,tests/fitting/test_$(name).py)
CONFIGURE = PATH=$(CURDIR)/$(BIN):$$PATH cmake -G Ninja -S . -DCMAKE_BUILD_TYPE=Release -DLFGS_CUDA=OFF \
  -DPython_EXECUTABLE=$(CURDIR)/$(BIN)/python -Dpybind11_DIR=$$($(BIN)/python -m pybind11 --cmakedir) \
  -DSKBUILD_PROJECT_VERSION_FULL=$$(sed -n 's/^version = "\(.*\)"/\1/p' pyproject.toml)
PRELOAD = $(foreach library,libasan.so libubsan.so libstdc++.so,$(shell g++ -print-file-name=$(library)))

sanitize: sanitize-threads sanitized-module
	LFGS_STRESS_SAMPLE=$$(git rev-parse HEAD) $(SANITIZED_PYTEST) $(SANITIZED)

sanitize-all: sanitize-threads sanitized-module
	$(SANITIZED_PYTEST) tests

# MAKEFLAGS=, or ninja complains that it cannot share make's jobs.
sanitize-threads: setup
	$(CONFIGURE) -B build/threads -DLFGS_SANITIZE=thread
	MAKEFLAGS= PATH=$(CURDIR)/$(BIN):$$PATH cmake --build build/threads --target stages_on_threads
	build/threads/stages_on_threads

sanitized-module: setup
	$(CONFIGURE) -B build/sanitize -DLFGS_SANITIZE=address,undefined
	MAKEFLAGS= PATH=$(CURDIR)/$(BIN):$$PATH cmake --build build/sanitize --target _core

SANITIZED_PYTEST = LD_PRELOAD="$(PRELOAD)" ASAN_OPTIONS=detect_leaks=0:quarantine_size_mb=16 \
  UBSAN_OPTIONS=print_stacktrace=1 LFGS_CORE=$$(ls build/sanitize/_core*.so) \
  $(PYTEST) $(BESIDE) --capture=sys -m "not not_sanitized"

# The CUDA sources compiled for every kind of card that the kernels know, in a module that is not installed and needs no
# GPU to load; and what it says of itself. Needs nvcc.
CUDA_ARCHITECTURES := 75;86;89;90;120
cuda-module: setup
	$(CONFIGURE) -B build/cuda -DLFGS_CUDA=ON "-DLFGS_CUDA_ARCHITECTURES=$(CUDA_ARCHITECTURES)"
	MAKEFLAGS= PATH=$(CURDIR)/$(BIN):$$PATH cmake --build build/cuda --target _core
	LFGS_CORE=$$(ls build/cuda/_core*.so) $(PYTEST) tests/house/test_build.py

# The stubs of the native module, lightfield_gs/_core/*.pyi, from a build with CUDA, for only that has all of it.
stubs: cuda-module
	LFGS_CORE=$$(ls build/cuda/_core*.so) $(BIN)/python csrc/bind/stubs.py lightfield_gs

# The stages on 64-bit ARM: cross-compiled, run by QEMU, and compared with the same program on this processor and with the
# native module.
# Libraries for ARM are the system's where it has them (they came with Highway's), else the cross compiler's: of the two
# mixed, programs hang.
QEMU = qemu-aarch64 $(if $(wildcard /lib/ld-linux-aarch64.so.1),,-L /usr/aarch64-linux-gnu)
STAGES = -DLFGS_MODULE=OFF -DCMAKE_BUILD_TYPE=Release -G Ninja -S .
test-arm: setup $(VENV)/.arm
	$(call stages,arm,-DCMAKE_TOOLCHAIN_FILE=cmake/aarch64-linux-gnu.cmake)
	$(call stages,x86)
	$(QEMU) build/arm/stages_to_file build/arm/stages
	$(call compare_stages,arm,NEON)

# The stages on Windows: cross-compiled by Zig, run by Wine, and compared in the same way. For 64-bit ARM with Windows and
# with macOS they are compiled and linked, which nothing here can run. The first time Zig compiles its C++ library too.
# ZIG_OPTIONS, for a machine without GitHub: -DFETCHCONTENT_SOURCE_DIR_HWY=FOLDER -DFETCHCONTENT_SOURCE_DIR_GLM=FOLDER
# -DBUILD_TESTING=OFF
WINE = WINEPREFIX=$(CURDIR)/build/wine WINEDEBUG=-all WINEDLLOVERRIDES="mscoree,mshtml=" wine
ZIG_OPTIONS ?=
ZIG = -DCMAKE_TOOLCHAIN_FILE=cmake/zig.cmake -DLFGS_ZIG=$(CURDIR)/$(VENV)/zig/bin/python $(ZIG_OPTIONS)
test-windows: setup $(VENV)/.windows
	$(call stages,x86)
	$(call stages,windows,$(ZIG) -DLFGS_TARGET=x86_64-windows-gnu)
	$(WINE) build/windows/stages_to_file.exe build/windows/stages
	$(call compare_stages,windows,SSE4)
	$(call stages,windows-arm,$(ZIG) -DLFGS_TARGET=aarch64-windows-gnu)
	$(call stages,macos-arm,$(ZIG) -DLFGS_TARGET=aarch64-macos)

# stages_to_file in build/$(1), with the options $(2) of CMake; and the tests of what it wrote there, by the vectors $(2)
define stages
	PATH=$(CURDIR)/$(BIN):$$PATH cmake $(STAGES) -B build/$(1) $(2)
	MAKEFLAGS= PATH=$(CURDIR)/$(BIN):$$PATH cmake --build build/$(1) --target stages_to_file
endef
define compare_stages
	build/x86/stages_to_file build/x86/stages
	LFGS_STAGES_ELSEWHERE=build/$(1)/stages LFGS_STAGES_VECTORS=$(2) LFGS_STAGES_HERE=build/x86/stages \
	  $(PYTEST) tests/native
endef

# The native module by Clang, with GCC's warnings as errors, and the tests of the rasterizer with it.
clang: setup
	@command -v clang++ >/dev/null || { echo "make: no clang++ (Debian: sudo apt-get install clang)"; exit 1; }
	$(CONFIGURE) -B build/clang -DCMAKE_CXX_COMPILER=clang++ -DCMAKE_CXX_FLAGS=-Werror
	MAKEFLAGS= PATH=$(CURDIR)/$(BIN):$$PATH cmake --build build/clang --target _core
	LFGS_CORE=$$(ls build/clang/_core*.so) $(PYTEST) $(BESIDE) tests/rasterizer

# What is read rather than run: style and types, with the versions of the extra "dev".
CLANG_FORMATTED = $(shell find csrc tests/native tests/cuda_on_cpu -name '*.cpp' -o -name '*.h' -o -name '*.cu' -o -name '*.cuh')
lint: setup $(VENV)/.dev
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/clang-format --dry-run -Werror $(CLANG_FORMATTED)
	for system in linux win32 darwin; do $(BIN)/mypy --platform $$system --cache-dir build/mypy-$$system || exit 1; done

# The tests of the GPU under the tools of compute-sanitizer, on a machine that has one: PYTHON has the package, built for
# it, and pytest. CUDA_TOOLS, and CUDA_SECONDS for each, where a run may last only so long: the next one goes on with it.
CUDA_TOOLS := memcheck racecheck initcheck
CUDA_SECONDS ?= inf
sanitize-cuda: $(CUDA_TOOLS)
.PHONY: $(CUDA_TOOLS)

$(CUDA_TOOLS):
	$(PYTHON) tests/sanitize_cuda.py $@ --seconds $(CUDA_SECONDS)

# Damaged files for every reader; FUZZ_INPUTS=1000000 takes half an hour.
FUZZ_INPUTS ?= 100000
fuzz: setup
	$(BIN)/python -m pip install -q atheris || echo "make: no atheris for this Python; random changes instead"
	cd tests && PYTHONPATH=$(CURDIR):$(CURDIR)/tests ../$(BIN)/python -m fuzzing --inputs $(FUZZ_INPUTS)

# The pages of docs/ as a website, with the reference that is made of docstrings: build/docs/index.html.
docs: setup $(VENV)/.docs
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict

bench: setup
	$(BIN)/lightfield-gs bench --scene sheet:128,sheet:512,cloud:262144 --cone 5,40 --json bench.json

clean:
	rm -rf build demo bench.json $(VENV)/.installed $(VENV)/.docs $(VENV)/.dev $(VENV)/.photo

# What the system must have, $(1): installed as root, named otherwise, with what comes of doing without, $(2).
define system_packages
	@missing=""; \
	if command -v dpkg-query >/dev/null; then \
	  for package in $(1); do \
	    dpkg-query -W -f '$${Status}' $$package 2>/dev/null | grep -q 'ok installed' || missing="$$missing $$package"; \
	  done; \
	fi; \
	if [ -n "$$missing" ] && [ "$$(id -u)" = 0 ]; then \
	  apt-get update -q && DEBIAN_FRONTEND=noninteractive apt-get install -q -y --no-install-recommends $$missing; \
	elif [ -n "$$missing" ]; then \
	  echo "make: not installed:$$missing; to install: sudo apt-get install$$missing"; \
	  echo "make: going on without: $(2)"; \
	fi
endef

# Compiler, and headers that CMake would else download.
$(VENV)/.system:
	$(call system_packages,$(DEBIAN_PACKAGES),CMake downloads GLM and Highway where they are missing)
	@command -v c++ >/dev/null || { echo "make: no C++ compiler; install g++ (Debian: sudo apt-get install g++)"; exit 1; }
	@mkdir -p $(VENV) && touch $@

# Mesa's lavapipe, a GPU that is a program, for the tests of WebGPU. They are skipped where it cannot be installed.
$(VENV)/.vulkan: | $(VENV)/.system
	-$(call system_packages,$(VULKAN_PACKAGES),tests of WebGPU are skipped)
	@touch $@

# The cross compiler and QEMU. Highway is a library: Debian has it for ARM once dpkg knows of that kind of processor,
# which is not changed here, and CMake downloads it elsewhere.
$(VENV)/.arm: | $(VENV)/.system
	$(call system_packages,$(ARM_PACKAGES),they may be here by other means)
	@for program in aarch64-linux-gnu-g++ qemu-aarch64; do command -v $$program >/dev/null || { \
	  echo "make: no $$program (Debian: sudo apt-get install $(ARM_PACKAGES))"; exit 1; }; done
	@ls /usr/lib/aarch64-linux-gnu/libhwy.so >/dev/null 2>&1 || echo "make: no Highway for ARM: CMake downloads it;" \
	  "or (Debian) sudo dpkg --add-architecture arm64 && sudo apt-get update && sudo apt-get install libhwy-dev:arm64"
	@touch $@

# Wine, and Zig in an environment of its own.
$(VENV)/.windows: | $(VENV)/.system
	$(call system_packages,$(WINE_PACKAGES),it may be here by other means)
	@command -v wine >/dev/null || { echo "make: no wine (Debian: sudo apt-get install $(WINE_PACKAGES))"; exit 1; }
	$(PYTHON) -m venv $(VENV)/zig
	$(VENV)/zig/bin/python -m pip install -q ziglang==0.17.1
	@touch $@

# torch comes from the constraint, as its CPU build; no other may get in.
$(VENV)/.python: constraints.txt | $(VENV)/.system
	$(PYTHON) -m venv $(VENV)
	@$(BIN)/python -m pip install -q -c constraints.txt torch || { \
	  echo "make: if this package index has no CPU build of torch, try"; \
	  echo "make:   PIP_EXTRA_INDEX_URL=https://download.pytorch.org/whl/cpu make $(MAKECMDGOALS)"; exit 1; }
	$(BIN)/python -m pip install -q -c constraints.txt scikit-build-core pybind11 ninja
	@touch $@

# Where files lie is known to the installation; what is in them is read anew every time.
$(VENV)/.files: FORCE
	@mkdir -p $(VENV) && find lightfield_gs training benchmarks -name '*.py' | sort > $@.now
	@cmp -s $@.now $@ && rm $@.now || mv $@.now $@

$(VENV)/.installed: pyproject.toml $(NATIVE_SOURCES) $(VENV)/.files $(VENV)/.python
	$(BIN)/python -m pip install -q -c constraints.txt --no-build-isolation -e '.[test]'
	@touch $@

# What the extras `docs`, `dev` and `photo` name, and not the package once more, which would be compiled for it.
$(VENV)/.docs $(VENV)/.dev $(VENV)/.photo: $(VENV)/.%: pyproject.toml $(VENV)/.python
	$(BIN)/python -m pip install -q -c constraints.txt $$(sed -n 's/", "/ /g; s/^$* = \["\(.*\)"\].*/\1/p' pyproject.toml)
	@touch $@
