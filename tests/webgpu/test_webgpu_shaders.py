"""The sources of csrc/webgpu, fitted to kinds of frames: limits of WebGPU, and the compilers, naga and Tint."""

import json
import re

import chromium
import pytest

from lightfield_gs.webgpu.pipelines import Pipelines
from lightfield_gs.webgpu.shaders import BINDINGS, STAGES, Variant, source

VARIANTS = (
    Variant(),
    Variant(3, bgr=True, harmonics=True, compensated=True, floats=True),
    Variant(6, ends_early=True),
    Variant(cells=True, harmonics=True, compensated=True),
)
OPEN = """(async () => {
  const adapter = navigator.gpu && await navigator.gpu.requestAdapter();
  window.device = adapter && await adapter.requestDevice();
  return Boolean(window.device);
})()"""
COMPILE = """(async ([code, entries, entryPoint]) => {
  device.pushErrorScope("validation");
  const module = device.createShaderModule({code}), info = await module.getCompilationInfo();
  const layout = device.createPipelineLayout({bindGroupLayouts: [device.createBindGroupLayout({entries})]});
  device.createComputePipeline({layout, compute: {module, entryPoint}});
  const error = await device.popErrorScope();
  return [...info.messages.map(m => `${m.lineNum}: ${m.message}`), ...(error ? [error.message] : [])];
})"""


@pytest.mark.parametrize("stage", STAGES)
def test_a_stage_keeps_to_what_webgpu_guarantees(stage):
    kinds = [BINDINGS[name][1] for name in STAGES[stage].bindings]
    assert sum("storage" in kind for kind in kinds) <= 8
    text = re.sub("//(?![{q]).*", "", source(stage, Variant(3)))
    assert not re.search(r"^\s*(enable|requires)\b|\bf16\b|subgroup", text, re.MULTILINE)
    assert "[q]" not in text and "//{" not in text


def test_samples_of_a_thread_are_variables_of_their_own():
    text = source("composite", Variant(2))
    assert "let px_1 = f32(column_1 - origin) + 0.5;" in text and "px_2" not in text
    assert "px_5" in source("composite", Variant())


@pytest.mark.not_sanitized
def test_naga_compiles_every_stage(frames):
    pipelines = Pipelines(frames.device)
    for variant in VARIANTS:
        for stage in STAGES:
            assert pipelines.stage(stage, variant)  # errors are raised


@pytest.mark.slow
@pytest.mark.not_sanitized
def test_chromium_compiles_every_stage(tmp_path):
    (tmp_path / "page.html").write_text("<p>")
    browser = chromium.Browser(tmp_path, 300, 300, gpu=chromium.SWIFTSHADER)
    try:
        browser.open((tmp_path / "page.html").as_uri())
        browser.wait("location.protocol == 'file:' && document.readyState == 'complete'")
        if not browser.run(OPEN):
            pytest.skip("this Chromium has no adapter for WebGPU")
        for variant in VARIANTS:
            for stage in STAGES:
                bindings = [BINDINGS[name] for name in STAGES[stage].bindings]
                entries = [{"binding": number, "visibility": 4, "buffer": {"type": kind}} for number, kind in bindings]
                arguments = json.dumps([source(stage, variant), entries, stage])
                assert browser.run(f"{COMPILE}({arguments})") == [], (stage, variant)
    finally:
        browser.close()
