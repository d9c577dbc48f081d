"""Curves over time, each on an axis of its own with its limits, as papers show a motion."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from sysid_bench.reporting.figure_files import COLOURS, DOUBLE, new_figure, plain, write_figure
from sysid_bench.types import Curve

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_HEIGHT: Final = 0.85  # inches an axis
_COLUMNS: Final = 2


@dataclass(frozen=True, eq=False)
class StoredCurves:
    """Curves that a cell stored, and the title of their figure."""

    title: str
    curves: tuple[Curve, ...]


def curve_figure(path: Path, sample: StoredCurves, width: float = DOUBLE) -> Path:
    """Draw curves (width in inches) into a .pdf, .png or .svg file, the same bytes every time.

    Raises UsageError for another suffix.
    """
    return write_figure(lambda: _figure(sample, width), path)


def _figure(sample: StoredCurves, width: float) -> "Figure":
    rows = -(-len(sample.curves) // _COLUMNS)
    picture = new_figure(_HEIGHT * rows + 0.5, width)
    grid = picture.subplots(rows, _COLUMNS, sharex=True, squeeze=False)
    names = list(dict.fromkeys(name for curve in sample.curves for name in curve.series))
    lines: dict[str, Any] = {}
    for axes, curve in zip(grid.flat, sample.curves, strict=False):
        lines |= _draw(axes, curve, names)
    for axes in grid.flat[len(sample.curves) :]:
        axes.set_visible(False)
    for axes in grid[-1]:
        axes.set_xlabel("time [s]")
    named = {plain(name): line for name, line in lines.items() if name}
    if named:
        picture.legend(
            named.values(), named, ncols=len(named), loc="outside upper right", frameon=False
        )
    return picture


def _draw(axes: "Axes", curve: Curve, names: list[str]) -> dict[str, Any]:
    """The lines of a curve by name; a name has one colour on all axes."""
    lines = {}
    for name, values in curve.series.items():
        colour = COLOURS[names.index(name) % len(COLOURS)]
        (lines[name],) = axes.plot(curve.t, values, color=colour)
    for limit in curve.limits or ():
        axes.axhline(limit, color="#bbbbbb", linestyle="--", linewidth=0.6)
    if curve.unit:
        axes.set_ylabel(f"{plain(curve.name)} [{plain(curve.unit)}]")
    else:
        axes.set_title(plain(curve.name), loc="left", fontsize=7, pad=2)
    axes.margins(x=0)
    axes.spines[["top", "right"]].set_visible(False)
    return lines
