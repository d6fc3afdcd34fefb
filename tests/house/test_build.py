"""The information on a build."""

import re
import shutil
import subprocess
from importlib.metadata import version

import pytest

from lightfield_gs import _core, build_info

needs_cuda = pytest.mark.skipif(not hasattr(_core, "cuda"), reason="needs a build with LFGS_CUDA")


def test_version_and_devices():
    info = build_info()
    assert info["version"] == version("lightfield-gs") and info["simd_targets"]
    assert info["devices"] == (["cpu", "cuda"] if hasattr(_core, "cuda") else ["cpu"])
    assert ("cuda_architectures" in info) == hasattr(_core, "cuda")


@needs_cuda
def test_cuda_architectures_are_numbers():
    found = build_info()["cuda_architectures"]
    assert found and found == sorted(set(found)) and all(50 <= value < 200 for value in found)


@needs_cuda
@pytest.mark.skipif(shutil.which("cuobjdump") is None, reason="needs cuobjdump, of the CUDA toolkit")
def test_cuda_architectures_are_those_of_the_machine_code():
    listed = subprocess.run(
        ["cuobjdump", "--list-elf", "--list-ptx", _core.__file__], capture_output=True, text=True, check=True
    ).stdout
    assert {int(number) for number in re.findall(r"sm_(\d+)", listed)} == set(build_info()["cuda_architectures"])
