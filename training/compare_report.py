"""The report of a comparison: scores of every arm, per angle, as JSON, as tables and as plots."""

from __future__ import annotations

import hashlib
import json
import math
import statistics
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from torch import Tensor

from lightfield_gs.base.device import choose_device
from lightfield_gs.base.errors import InputError
from lightfield_gs.io.atomic import atomic_path
from lightfield_gs.io.text_files import parse_json, read_object
from lightfield_gs.models import SplatterNet
from training.comparison import SIZE_PX
from training.config import TrainingConfig
from training.data.background import Choice
from training.data.cache import fingerprint
from training.data.objects import find_objects
from training.evaluation import labelled, score_folder
from training.ranges import check_ranges

FLOORS = {"copy": "copy the input", "card": "flat card"}
_SPLIT = "val"
_TARGETS = ("cone_deg", "cone_margin", "elevation_deg", "target_data")  # fields that the report says in words
LIMIT_BYTES = 64 << 20
# The results of score_folder, for each arm and each scored folder.
Scores = dict[str, dict[str, dict[str, Any]]]


@dataclass(frozen=True)
class Scored:
    """A folder of objects that runs are scored on in the end.

    Args:
        folder: the folder.
        size_px: longer side of the pictures that are compared.
        detail: how many times finer than the network's pictures the sheet of the source is: 1, 2 or 4; 0: no sheet.
    """

    folder: str
    size_px: int = SIZE_PX
    detail: Literal[0, 1, 2, 4] = 0

    def __post_init__(self) -> None:
        check_ranges(self, "scored: ", size_px=(16, 4096))

    def identity(self, background: Choice) -> list[Any]:
        """Return what decides the scores, beside the weights."""
        objects = [self.folder, fingerprint(find_objects(Path(self.folder), _SPLIT), background)]
        otherwise = [self.size_px, self.detail]
        return objects if otherwise == [SIZE_PX, 0] else objects + otherwise


def _final_weights(run: TrainingConfig) -> Path:
    return Path(run.output_dir) / "model.safetensors"


def is_finished(run: TrainingConfig) -> bool:
    """Whether a run has its final weights. Raises InputError where they were trained with another configuration."""
    from safetensors import SafetensorError, safe_open

    path = _final_weights(run)
    if not path.exists():
        return False
    try:
        with safe_open(path, framework="pt") as file:
            trained = parse_json((file.metadata() or {}).get("training", "null"))
    except (SafetensorError, OSError, ValueError) as error:
        raise InputError(f"{path}: expected weights of a run, but {' '.join(str(error).split())}") from None
    if changed := run.differences(trained):
        raise InputError(
            f"{path}: was trained with another configuration ({', '.join(changed)} differ): give the one "
            "of the run, or another output_dir"
        )
    return True


def score_arm(
    run: TrainingConfig, scored: dict[str, Scored], decoded: dict[Path, Tensor], now: bool = True
) -> dict[str, Any] | None:
    """Return scores of a finished run in each folder.

    They stay beside the weights as long as the weights and the data are the same.

    Args:
        decoded: See score_folder.
        now: Score it where that has not been done; False: return None then.

    Raises:
        InputError: the data cannot be used.
    """
    weights = _final_weights(run)
    of = {
        "weights": hashlib.sha256(weights.read_bytes()).hexdigest(),
        "data": {name: objects.identity(run.background) for name, objects in scored.items()},
    }
    kept = weights.with_name("final_scores.json")
    if kept.exists() and (known := read_object(kept, LIMIT_BYTES)).get("of") == of:
        return known["scores"]
    if not now:
        return None
    device = choose_device(run.device)
    net = SplatterNet.from_pretrained(weights).to(device)
    scores = {
        name: score_folder(
            net,
            Path(objects.folder),
            split=_SPLIT,
            device=device,
            decoded=decoded,
            background=run.background,
            size_px=objects.size_px,
            detail=objects.detail or None,
        )
        for name, objects in scored.items()
    }
    with atomic_path(kept) as temporary:
        temporary.write_text(json.dumps({"of": of, "scores": scores}, indent=1) + "\n")
    return scores


def read_curve(run: TrainingConfig) -> list[dict[str, float]]:
    """The validations of a run so far, each with its step."""
    path = Path(run.output_dir) / "scores.jsonl"
    return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []


def leads(scores: Scores) -> Scores:
    """How far the first finished arm is ahead of each other one: psnr_db and ssim for each label of each folder.

    That over all views has psnr_standard_error too: of the mean over objects, which are what the views depend on.
    """
    first, *others = scores

    def lead(ours: dict[str, Any], theirs: dict[str, Any]) -> dict[str, dict[str, float]]:
        rows = dict(labelled(theirs))
        found = {
            label: {name: row[name] - rows[label][name] for name in ("psnr_db", "ssim")}
            for label, row in labelled(ours)
        }
        of_objects = [psnr - theirs["object_psnr_db"][name] for name, psnr in ours["object_psnr_db"].items()]
        if len(of_objects) > 1:
            found["all"]["psnr_standard_error"] = statistics.stdev(of_objects) / math.sqrt(len(of_objects))
        return found

    return {
        other: {folder: lead(scores[first][folder], theirs) for folder, theirs in scores[other].items()}
        for other in others
    }


def markdown_table(head: list[str], rows: list[list[str]]) -> str:
    """A table in Markdown: its head, and its rows of as many cells."""
    return "\n".join(f"| {' | '.join(cells)} |" for cells in (head, ["---"] * len(head), *rows))


def lead_cell(lead: dict[str, float]) -> str:
    """A lead as tables have it: dB (+- standard error where it is known) / SSIM."""
    error = f" +- {lead['psnr_standard_error']:.2f}" if "psnr_standard_error" in lead else ""
    return f"{lead['psnr_db']:+.2f}{error} / {lead['ssim']:+.3f}"


def _length(run: TrainingConfig) -> str:
    """Return how long a run is, in words."""
    if run.by_time:
        return f"{run.total_seconds / 60:g} minutes, {run.targets + 1} views of each object"
    samples = sum(stage.steps * stage.objects for stage in run.stages)
    return f"{run.total_steps:,} steps, {samples:,} samples of {run.targets + 1} views"


def _other_fields(arm: TrainingConfig, first: TrainingConfig) -> str:
    """Return in words what an arm has otherwise than the first, beside its targets."""
    names = arm.differences(json.loads(json.dumps(first.identity())))
    others = [name for name in names if name not in _TARGETS]
    return f"; other {', '.join(others)}" if others else ""


def to_markdown(runs: dict[str, TrainingConfig], scores: Scores) -> str:
    """The tables: PSNR / SSIM of every arm and floor by angle, holes and ghosts, and the leads of the first arm."""
    run = next(iter(runs.values()))
    lines = [
        "# Targets inside the cone and all round",
        "",
        f'Network `{run.model}`, {_length(run)}. PSNR in dB / SSIM; "all" are the novel '
        "views, +- the standard error over objects; 100 dB: equal.",
        "",
    ]
    lines += [
        f"- {name}: targets within {arm.azimuth_deg:g} degrees of azimuth and {arm.elevation_deg:g} of elevation "
        f"of the source{_other_fields(arm, run)}{'' if name in scores else '; not finished'}"
        for name, arm in runs.items()
    ]
    first, *others = scores
    differences = leads(scores)
    for folder, report in scores[first].items():
        columns = [dict(labelled(arm[folder])) for arm in scores.values()]
        rows = [
            [
                label,
                str(row["views"]),
                *(f"{column[label]['psnr_db']:.2f} / {column[label]['ssim']:.3f}" for column in columns),
                *(f"{row[f'{floor}_psnr_db']:.2f} / {row[f'{floor}_ssim']:.3f}" for floor in FLOORS),
            ]
            for label, row in labelled(report)
        ]
        lines += ["", f"## {folder}", "", markdown_table(["angle", "views", *scores, *FLOORS.values()], rows)]
        if skipped := report.get("skipped"):
            lines += ["", f"{len(skipped)} objects could not be scored: {', '.join(skipped)}"]
        if "holes" in report:
            rows = [
                [label, *(f"{column[label]['holes']:.2f} / {column[label]['ghosts']:.2f}" for column in columns)]
                for label, _ in labelled(report)
            ]
            lines += ["", markdown_table(["holes % / ghosts %", *scores], rows)]
        if others:
            rows = [
                [label, *(lead_cell(lead[folder][label]) for lead in differences.values())]
                for label, _ in labelled(report)
            ]
            lines += ["", markdown_table(["angle", *(f"{first} - {other}" for other in others)], rows)]
    return "\n".join(lines) + "\n"


def _save_plots(output: Path, scores: Scores, curves: dict[str, list[dict[str, float]]]) -> None:
    """angles.png: PSNR by angle in each folder; curves.png: PSNR over training."""
    from matplotlib.figure import Figure  # not pyplot, which looks for a display

    folders = next(iter(scores.values()))
    figure = Figure(figsize=(6 * len(folders), 4.5), layout="constrained")
    for axes, (folder, report) in zip(figure.subplots(1, len(folders), squeeze=False)[0], folders.items()):
        for arm, of_folders in scores.items():
            labels, rows = zip(*labelled(of_folders[folder])[:-1])
            axes.plot(labels, [row["psnr_db"] for row in rows], "o-", label=arm)
        for floor, meaning in FLOORS.items():  # perfect for the source, which they are made of
            labels, rows = zip(*labelled(report)[1:-1])
            axes.plot(labels, [row[f"{floor}_psnr_db"] for row in rows], ".--", label=meaning)
        axes.set(title=folder, xlabel="azimuth from the source", ylabel="PSNR, dB")
        axes.legend()
    save_figure(figure, output / "angles.png")
    figure = Figure(figsize=(6, 4.5), layout="constrained")
    axes = figure.subplots()
    for arm, rows in ((arm, rows) for arm, rows in curves.items() if rows):
        axes.plot([row["step"] for row in rows], [row["psnr_db"] for row in rows], ".-", label=arm)
    axes.set(title="validation during training", xlabel="steps", ylabel="PSNR, dB")
    if axes.has_data():
        axes.legend()
    save_figure(figure, output / "curves.png")


def save_figure(figure: Any, path: Path) -> None:
    """Writes a figure as PNG, atomically."""
    with atomic_path(path) as temporary:
        figure.savefig(temporary, dpi=120)


def write_report(
    output: Path, runs: dict[str, TrainingConfig], scored: dict[str, Scored], scoring: Collection[str]
) -> str:
    """Score arms that are finished, write report.json, report.md, angles.png, curves.png; return the tables.

    Args:
        scoring: The arms to score; the report has the others where they have been scored.

    Raises:
        InputError: no arm is finished; or as is_finished and score_arm.
    """
    decoded: dict[Path, Tensor] = {}
    finished = {name: run for name, run in runs.items() if is_finished(run)}
    found = {name: score_arm(run, scored, decoded, name in scoring) for name, run in finished.items()}
    scores = {name: scores_of_arm for name, scores_of_arm in found.items() if scores_of_arm is not None}
    if not scores:
        raise InputError(f"{output}: found no finished arm: run the command without --report-only first")
    curves = {name: read_curve(run) for name, run in runs.items()}
    tables = to_markdown(runs, scores)
    report = {
        "runs": {name: run.identity() for name, run in runs.items()},
        "scores": scores,
        "leads": leads(scores),
        "curves": curves,
    }
    for name, text in (("report.json", json.dumps(report, indent=1) + "\n"), ("report.md", tables)):
        with atomic_path(output / name) as temporary:
            temporary.write_text(text)
    _save_plots(output, scores, curves)
    return tables
