"""Compiles the CUDA stages for the CPU: kernels become functions that a fiber per thread runs (include/cuda_runtime.h).

python build.py CSRC OUT [INCLUDE ...] makes OUT/_core*.so, a native module whose `cuda` part works on CPU tensors. Its
CPU stages are not in it, but for the plan that `sorted` makes on the host.
"""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
import sysconfig
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

HERE = Path(__file__).parent
FLAGS = [
    "-std=c++20",
    "-O1",
    "-fPIC",
    "-w",
    "-march=x86-64-v3",
    "-ffp-contract=off",
    "-fvisibility=hidden",
    "-DLFGS_WITH_CUDA",
    '-DLFGS_VERSION="emulated"',
    "-D__CUDA_ARCH__=900",
    "-D__CUDA_ARCH_LIST__=900",
]
COMPILER = ["ccache", "g++"] if shutil.which("ccache") else ["g++"]
APPROXIMATE = {"ex2": "exp2f({})", "rcp": "1 / ({})", "rsqrt": "1 / sqrtf({})", "sqrt": "sqrtf({})"}


def host_code(path: Path) -> str:
    """A CUDA source as C++."""
    text = path.read_text()
    # kernel<<<grid, block, bytes, stream>>>(arguments)
    text = re.sub(
        r"([A-Za-z_]\w*(?:<[\w:, ]+>)?)\s*<<<(.*?)>>>",
        r"emulation::launch([=](const auto&... a) { \1(a...); }, \2)",
        text,
        flags=re.S,
    )
    text = re.sub(
        r'asm\("(\w+)\.approx\.ftz\.f32 %0, %1;" : "=f"\((\w+)\) : "f"\((\w+)\)\);',
        lambda m: f"{m[2]} = {APPROXIMATE[m[1]].format(m[3])};",
        text,
    )
    text = re.sub(
        r'asm\("ex2\.approx\.f16x2 %0, %1;" : "=r"\((\w+)\) : "r"\((.+?)\)\);', r"\1 = exp2_halves(\2);", text
    )
    text = re.sub(
        r"extern __shared__ (?:__align__\(\d+\) )?(\w+) (\w+)\[\];",
        r"auto* \2 = reinterpret_cast<\1*>(emulation::dynamic_shared);",
        text,
    )
    text = re.sub(r"__shared__ (alignas\(\d+\))", r"\1 __shared__", text)
    if path.name == "lens_column_operands.cuh":  # its tensor cores are in include/tensor_cores.h
        begin, end = text.index("__device__ inline void multiply("), text.index("template <bool Limit>")
        text = f"{text[:begin]}}}\n#include <tensor_cores.h>\nnamespace lfgs::cuda {{\n{text[end:]}"
    return f"#include <cuda_runtime.h>\n{text}" if path.suffix == ".cu" else text


def build(csrc: Path, out: Path, includes: list[str]) -> Path:
    """The module. Raises CalledProcessError."""
    sources = []
    for room in ("cuda", "network"):
        for path in sorted((csrc / room).rglob("*.*")):
            copy = out / "src" / path.relative_to(csrc)
            copy.parent.mkdir(parents=True, exist_ok=True)
            copy.write_text(host_code(path))
            sources += [copy] if path.suffix == ".cu" else []
    sources += sorted((csrc / "bind").glob("*.cpp"))
    sources += [csrc / "cpu/sorted/plan_sorted.cpp", csrc / "base/parallel.cpp"]
    include = [f"-I{p}" for p in (HERE / "include", out / "src", csrc, sysconfig.get_paths()["include"], *includes)]

    def compile_(source: Path) -> str:
        target = out / f"{source.parent.name}_{source.name}.o"
        subprocess.run([*COMPILER, *FLAGS, *include, "-x", "c++", "-c", source, "-o", target], check=True)
        return str(target)

    with ThreadPoolExecutor(4) as pool:  # as many as the files of tests whose processes wait for it
        objects = list(pool.map(compile_, sources))
    module = out / f"_core{sysconfig.get_config_var('EXT_SUFFIX')}"
    subprocess.run(["g++", "-shared", "-Wl,-z,lazy", *objects, "-o", module, "-lhwy"], check=True)
    return module


if __name__ == "__main__":
    print(build(Path(sys.argv[1]), Path(sys.argv[2]), sys.argv[3:]))
