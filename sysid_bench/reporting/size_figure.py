"""Errors against the length of the training, robot by robot, above the repeatability floor."""

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from sysid_bench.reporting.figure_files import COLOURS, DOUBLE, new_figure, plain, write_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

COLUMNS: Final = 4
"""Robots side by side."""

LARGEST: Final = 10.0
"""Torque error at which a curve leaves the picture: ten times that of predicting no torque."""


@dataclass(frozen=True)
class SizeErrors:
    """Torque errors of one robot: by method the error at each length of the training (s); `floor`:
    the error of the training torque itself where the test repeats the motion."""

    robot: str
    errors: Mapping[str, Mapping[float, float]]
    floor: float | None


def size_figure(path: Path, sizes: tuple[SizeErrors, ...], width: float = DOUBLE) -> Path:
    """Draw errors against lengths into a .pdf, .png or .svg file, the same bytes every time. Raises
    UsageError for another suffix."""
    return write_figure(lambda: _picture(sizes, width), path)


def _label(axes: "Axes", one: SizeErrors) -> None:
    """The robot as title; lengths and a few errors as plain numbers."""
    from matplotlib import ticker

    axes.set_title(plain(one.robot), fontsize=7)
    lengths = sorted({s for errors in one.errors.values() for s in errors})
    axes.set_xticks(lengths, [f"{s:.2g}" for s in lengths])
    axes.xaxis.set_minor_formatter(ticker.NullFormatter())
    axes.yaxis.set_major_locator(ticker.LogLocator(subs=(1.0, 2.0, 5.0), numticks=5))
    axes.yaxis.set_major_formatter(ticker.StrMethodFormatter("{x:g}"))
    axes.yaxis.set_minor_formatter(ticker.NullFormatter())


def _curves(axes: "Axes", one: SizeErrors, methods: list[str]) -> "dict[str, Line2D]":
    """The curves of one robot, by method and "floor"."""
    drawn = {}
    for name, errors in one.errors.items():
        shown = {
            seconds: errors[seconds] for seconds in sorted(errors) if errors[seconds] < LARGEST
        }
        k = methods.index(name) % len(COLOURS)
        (drawn[name],) = axes.loglog(
            list(shown), list(shown.values()), "osD^vPX"[k] + "-", color=COLOURS[k]
        )
    if one.floor is not None:
        drawn["floor"] = axes.axhline(one.floor, color=COLOURS[6], linestyle=":")
    return drawn


def _name_axes(grid: Any, count: int) -> None:
    """Titles of the axes on the border; axes behind the last of `count` robots are left out."""
    for axes in grid.ravel()[count:]:
        axes.set_axis_off()
    for axes in grid[-1]:
        axes.set_xlabel("training [s]")
    for axes in grid[:, 0]:
        axes.set_ylabel("torque error")


def _picture(sizes: tuple[SizeErrors, ...], width: float) -> "Figure":
    lines = -(-len(sizes) // COLUMNS)
    picture = new_figure(1.2 * lines + 0.35, width)
    grid = picture.subplots(lines, COLUMNS, squeeze=False)
    methods = list(dict.fromkeys(chain.from_iterable(one.errors for one in sizes)))
    drawn: dict[str, Line2D] = {}
    for axes, one in zip(grid.ravel(), sizes, strict=False):
        drawn |= _curves(axes, one, methods)
        _label(axes, one)
        axes.spines[["top", "right"]].set_visible(False)
    _name_axes(grid, len(sizes))
    names = [name for name in (*methods, "floor") if name in drawn]
    handles = [drawn[name] for name in names]
    picture.legend(handles, names, ncols=len(names), loc="outside upper right", frameon=False)
    return picture
