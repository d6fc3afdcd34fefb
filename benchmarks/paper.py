"""`lightfield-gs bench paper`: our figures in the form of Tables 1 and 3 of the paper.

Shi et al., "Single-View Encoding of 3D Light Field Based on Editable Field of View Gaussian Splatting", Photonics 2025,
12(3), 279. Table 1: the time of an image of ten scenes, dense views and sub-pixels sorted by view. Table 3: the memory
of the stages (geometry, image, binning) before and after buffers are used again.
"""

from __future__ import annotations

import argparse
from statistics import fmean
from typing import Any

from lightfield_gs.bench import light_field
from lightfield_gs.bench.report import aligned, in_ms, megabytes, or_dash

SCENES = (
    "sheet:64",
    "sheet:96",
    "sheet:128",
    "sheet:192",
    "sheet:256",
    "sheet:384",
    "sheet:512",
    "cloud:16384",
    "cloud:65536",
    "cloud:262144",
)
METHODS = ("classic", "sorted", "direct")
STAGES = ("geometry", "image", "binning")  # of Table 3, which method "sorted" reports
# The paper's seconds for each of its ten images, 7680 x 3840 pixels of 96 views, on an RTX 3090
TABLE_1 = {
    "classic": (1.476, 1.102, 1.287, 1.582, 1.069, 1.661, 1.255, 0.976, 1.202, 1.491),  # without the interlacing
    "sorted": (0.052, 0.032, 0.044, 0.049, 0.029, 0.060, 0.035, 0.027, 0.032, 0.056),
}
TABLE_3_MB = {"geometry": 82, "image": 265, "binning": 1166}  # before buffers are used again, 128 x 128 Gaussians
TABLE_3_ALL_MB = (1513, 944)  # before and after
BESIDE = """\
The lines "paper" are the figures of Shi et al. (2025): an RTX 3090, 7680 x 3840 pixels, 96 views, and ten images of
the authors' own, so that card and scenes differ from ours. Their classic leaves out the interlacing. For 512 x 512
Gaussians they expect 24 GB. Their Table 2, a network trained in the original and in the constrained field of view,
800,000 steps of batch 4: 26.01 dB, SSIM .94 -> 29.77 dB, .97; ours: docs/benchmarks.md."""


def tables(rows: list[dict[str, Any]]) -> str:
    """The rows of scenes and methods (see bench.bench_case) as the two tables, the paper's lines below ours."""
    return "\n".join(
        [
            "Table 1: ms for an image",
            *_time_table(rows),
            "",
            "Table 3: MB held by a stage, all views at once -> views in chunks whose buffers are used again",
            *_memory_table(rows),
            "",
            BESIDE,
        ]
    )


def _time_table(rows: list[dict[str, Any]]) -> list[str]:
    """A line for each scene: the times of the methods, and how many times as fast as the first the others are. Then a
    line for each image of the paper, and the mean of them."""
    methods = list(dict.fromkeys(row["method"] for row in rows))
    cases: dict[tuple[Any, ...], dict[str, dict[str, Any]]] = {}
    for row in rows:
        cases.setdefault((row["scene"], row["cone"], row["sh_degree"]), {})[row["method"]] = row
    lines = [("scene", "Gaussians", "cone", *methods, *(f"{methods[0]}/{other}" for other in methods[1:]))]
    for (scene, _, _), by_method in cases.items():
        row = by_method[methods[0]]
        times = {method: by_method[method]["ms_median"] for method in methods}
        lines.append((scene, str(row["gaussians"]), f"{row['cone_deg']:.3g}", *_times(methods, times)))
    images = [dict(zip(TABLE_1, seconds)) for seconds in zip(*TABLE_1.values())]
    mean = {method: fmean(seconds) for method, seconds in TABLE_1.items()}
    for name, seconds in [*enumerate(images, 1), ("mean", mean)]:
        lines.append((f"paper {name}", "-", "-", *_times(methods, {key: 1e3 * s for key, s in seconds.items()})))
    return aligned(lines)


def _times(methods: list[str], ms: dict[str, float]) -> list[str]:
    """Return the cells of a line: the time of each method, and the first time over each other time."""
    first = ms.get(methods[0])
    ratios = [first / ms[other] if first and other in ms else None for other in methods[1:]]
    return [
        *("-" if method not in ms else in_ms(ms[method]) for method in methods),
        *(or_dash(r, ".1f") for r in ratios),
    ]


def _memory_table(rows: list[dict[str, Any]]) -> list[str]:
    """A line for each row: what each stage holds, where the method tells; else the work memory as a whole. Then the
    paper's."""
    lines: list[tuple[str, ...]] = [("scene", "method", *STAGES, "all work memory")]
    for row in rows:
        before, after = row["memory_bytes_unchunked"], row["memory_bytes"]
        stages = [
            f"{megabytes(before[stage])} -> {megabytes(after[stage])}" if before and after else "-" for stage in STAGES
        ]
        lines.append((row["scene"], row["method"], *stages, megabytes(row["work_bytes"])))
    before_mb, after_mb = TABLE_3_ALL_MB
    held = [f"{TABLE_3_MB[stage]} -> ?" for stage in STAGES]
    lines.append(("paper 128 x 128", "sorted", *held, f"{before_mb} -> {after_mb}"))
    return aligned(lines)


Options = light_field.Options


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the benchmark."""
    light_field.add_arguments(parser, SCENES, METHODS)


def run(given: Options) -> tuple[dict[str, Any], str]:
    """Return the rows of light-field images, for the scenes and methods of the paper by default, and its tables."""
    result = light_field.measure_cases(given, SCENES, METHODS)
    return result, "\n".join([tables(result["rows"]), *map(light_field.cost_line, result["harmonics"])])
