"""When targets inside the cone pay: `python -m training.compare_trend steps:1000=runs/a steps:3000=runs/b -o trend`.

Each argument AXIS:VALUE=FOLDER is a finished comparison as a point of an axis that was varied. The folder has the
report.json of training.compare. The output shows the lead of the first arm over another along each axis. <output>.md is
a table, <output>.png has a plot for each axis. A comparison may be a point of several axes.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any, NamedTuple

from lightfield_gs.base.errors import InputError
from lightfield_gs.io.atomic import atomic_path
from lightfield_gs.io.text_files import read_object
from training.command import with_line_errors
from training.compare_report import LIMIT_BYTES, lead_cell, markdown_table, save_figure

_ALL, _SOURCE = "all", "source"  # labels of training.evaluation.labelled
_MEANINGS = {_ALL: "all novel views", _SOURCE: "the source itself"}


class Point(NamedTuple):
    """A comparison on an axis: a value on it, and for each scored folder the leads by label."""

    axis: str
    value: float
    leads: dict[str, dict[str, dict[str, float]]]


def read_point(text: str, other: str | None) -> Point:
    """Return the point that AXIS:VALUE=FOLDER names.

    Args:
        other: The arm that the first is compared with; None: the only other.

    Raises:
        InputError: the text has another form, or the folder has no report of such arms.
    """
    place, equals, folder = text.partition("=")
    axis, colon, number = place.rpartition(":")
    try:
        value = float(number)
    except ValueError:
        value = float("nan")
    if not (axis and colon and equals and folder and 0 < value < float("inf")):
        raise InputError(f"{text}: expected AXIS:VALUE=FOLDER with a value above 0, for example steps:3000=runs/base")
    path = Path(folder) / "report.json"
    leads = read_object(path, LIMIT_BYTES).get("leads")
    if not isinstance(leads, dict) or not (leads if other is None else other in leads):
        raise InputError(f"{path}: expected the leads over {other or 'another arm'}: is the comparison finished?")
    if other is None and len(leads) > 1:
        raise InputError(f"{path}: has the arms {', '.join(leads)}: expected --other with one of them")
    return Point(axis, value, leads[other or next(iter(leads))])


def by_axis(points: list[Point]) -> dict[str, list[Point]]:
    """The points of each axis in the order of their values. Raises InputError where they were scored on unlike folders
    or two of them are in one place."""
    axes: dict[str, list[Point]] = {}
    for point in sorted(points, key=lambda point: point.value):
        if _labels(point) != _labels(points[0]):
            raise InputError("expected comparisons that were scored on the same folders at the same angles")
        if any(point.value == known.value for known in axes.setdefault(point.axis, [])):
            raise InputError(f"{point.axis}:{point.value:g}: expected one comparison a value, got two")
        axes[point.axis].append(point)
    return axes


def _labels(point: Point) -> dict[str, set[str]]:
    return {folder: set(leads) for folder, leads in point.leads.items()}


def to_markdown(axes: dict[str, list[Point]]) -> str:
    """The table: a row a point, with the leads in each folder over all views, on the farthest, and on the source."""
    folders = next(iter(axes.values()))[0].leads
    columns = [(folder, label) for folder, leads in folders.items() for label in (_ALL, _farthest(leads), _SOURCE)]
    head = ["varied", *(f"{folder}, {_MEANINGS.get(label, label)}" for folder, label in columns)]
    rows = [
        [f"{axis} {point.value:g}", *(lead_cell(point.leads[folder][label]) for folder, label in columns)]
        for axis, points in axes.items()
        for point in points
    ]
    return markdown_table(head, rows) + "\n"


def _farthest(leads: dict[str, Any]) -> str:
    """The label of the views that are farthest from the source: leads have the source, angles that rise, and all."""
    return list(leads)[-2]


def plot(axes: dict[str, list[Point]]) -> Any:
    """A figure with a plot for each axis: the lead over all novel views, with its error, and on the source view."""
    from matplotlib.figure import Figure  # not pyplot, which looks for a display

    figure = Figure(figsize=(4.5 * len(axes), 4), layout="constrained")
    for place, (axis, points) in zip(figure.subplots(1, len(axes), squeeze=False, sharey=True)[0], axes.items()):
        values = [point.value for point in points]
        for colour, folder in enumerate(points[0].leads):
            for label, style in ((_ALL, "o-"), (_SOURCE, "s--")):
                found = [point.leads[folder][label] for point in points]
                errors = [lead.get("psnr_standard_error", 0.0) for lead in found]
                leads = [lead["psnr_db"] for lead in found]
                look = {"fmt": style, "color": f"C{colour}", "capsize": 3, "label": f"{folder}, {_MEANINGS[label]}"}
                place.errorbar(values, leads, errors, **look)
        place.axhline(0, color="0.6", linewidth=0.8)
        place.set(xlabel=axis, xscale="log", title=f"lead against {axis}")
        place.set_xticks(values, [f"{value:,.0f}" if value >= 10 else f"{value:g}" for value in values])
        place.minorticks_off()
    figure.axes[0].set_ylabel("lead of the cone, dB")
    figure.axes[0].legend()
    return figure


@with_line_errors("training.compare_trend")
def main(arguments: list[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    parser = argparse.ArgumentParser(
        prog="python -m training.compare_trend",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("points", nargs="+", metavar="AXIS:VALUE=FOLDER", help="finished comparisons, values above 0")
    parser.add_argument("--other", help="arm that the first one is compared with (default: the only other)")
    parser.add_argument("-o", "--output", type=Path, required=True, help="path without suffix of table and plot")
    options = parser.parse_args(arguments)
    axes = by_axis([read_point(text, options.other) for text in options.points])
    table = to_markdown(axes)
    with atomic_path(options.output.with_name(options.output.name + ".md")) as temporary:
        temporary.write_text(table)
    save_figure(plot(axes), options.output.with_name(options.output.name + ".png"))
    print(table, end="")
    return 0


if __name__ == "__main__":
    sys.exit(main())
