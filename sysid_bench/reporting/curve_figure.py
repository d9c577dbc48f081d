"""Curves over time, each on an axis of its own with its limits, as papers show a motion."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final

from sysid_bench.reporting.figure_files import COLOURS, DOUBLE, new_figure, plain, write_figure
from sysid_bench.types import Curve

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_HEIGHT: Final = 0.85  # inches an axis
_COLUMNS: Final = 2


@dataclass(frozen=True, eq=False)
class CurveSample:
    """Curves that a cell stored, and the title of their figure."""

    title: str
    curves: tuple[Curve, ...]


def curve_figure(path: Path, sample: CurveSample, width: float = DOUBLE) -> Path:
    """Draw curves (width in inches) into a .pdf, .png or .svg file, the same bytes every time.

    Raises UsageError for another suffix.
    """
    return write_figure(lambda: _figure(sample, width), path)


def _figure(sample: CurveSample, width: float) -> "Figure":
    rows = -(-len(sample.curves) // _COLUMNS)
    picture = new_figure(_HEIGHT * rows + 0.5, width)
    grid = picture.subplots(rows, _COLUMNS, sharex=True, squeeze=False)
    for axes, curve in zip(grid.flat, sample.curves, strict=False):
        _draw(axes, curve)
    for axes in grid.flat[len(sample.curves) :]:
        axes.set_visible(False)
    for axes in grid[-1]:
        axes.set_xlabel("time [s]")
    lines, names = grid[0, 0].get_legend_handles_labels()
    if names:
        picture.legend(lines, names, ncols=len(names), loc="outside upper right", frameon=False)
    return picture


def _draw(axes: "Axes", curve: Curve) -> None:
    for k, (name, values) in enumerate(curve.series.items()):
        colour = COLOURS[k % len(COLOURS)]
        axes.plot(curve.t, values, color=colour, label=plain(name) if name else None)
    for limit in curve.limits or ():
        axes.axhline(limit, color="#bbbbbb", linestyle="--", linewidth=0.6)
    unit = f" [{plain(curve.unit)}]" if curve.unit else ""
    axes.set_ylabel(f"{plain(curve.name)}{unit}")
    axes.margins(x=0)
    axes.spines[["top", "right"]].set_visible(False)
