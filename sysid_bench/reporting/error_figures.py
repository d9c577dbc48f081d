"""Figures of errors: against the length of the training, and of simulation beside reality."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sysid_bench.reporting.figures import COLOURS, DOUBLE, WIDTH, new_figure, plain, write_figure
from sysid_bench.words import REFERENCE

if TYPE_CHECKING:
    import pandas as pd
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
    return write_figure(lambda: _draw_sizes(sizes, width), path)


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


def _draw_sizes(sizes: tuple[SizeErrors, ...], width: float) -> "Figure":
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


DRAWN: Final = ("wls", "lmi", "entropic", "a-priori")
"""Methods in the figure of training lengths."""


def size_errors(cells: "pd.DataFrame", joints: "pd.DataFrame") -> tuple[SizeErrors, ...]:
    """Return the errors of DRAWN methods by the length of the training, robot by robot."""
    found = []
    for name, every in cells.groupby("robot", sort=False):
        lengths = every.groupby("pipeline")["log.seconds"].nunique()
        part = every[every["pipeline"] == lengths.idxmax()]
        errors = {method: _by_length(part, method) for method in DRAWN}
        drawn = {method: points for method, points in errors.items() if points}
        found.append(SizeErrors(str(name), drawn, floor_of(cells_of_motions(part), joints)))
    return tuple(found)


def _by_length(cells: "pd.DataFrame", method: str) -> dict[float, float]:
    rows: Sequence[tuple[float, float]] = list(
        cells.loc[cells["estimator"] == method, ["log.seconds", "torque_error"]].itertuples(
            index=False, name=None
        )
    )
    return {float(s): float(e) for s, e in rows if math.isfinite(e)}


def cells_of_motions(cells: "pd.DataFrame") -> "pd.DataFrame":
    """Return the cells with whole training motions: the longest of each robot."""
    longest = cells.groupby("robot")["log.seconds"].transform("max")
    return cells[cells["log.seconds"] >= 0.9 * longest]


def floor_of(cells: "pd.DataFrame", joints: "pd.DataFrame") -> float | None:
    """Return the RMS over joints of the error of repeating the training torque; None where the test
    is another motion."""
    wanted = cells.loc[cells["estimator"] == REFERENCE, "id"]
    parts = joints[joints["id"].isin(wanted) & ~joints["small"].fillna(False).astype(bool)]
    squares = parts["replayed"].dropna().astype(float) ** 2
    # Pipelines filter the training torque differently, and the test torque alike.
    means = squares.groupby(parts["id"]).mean()
    return None if means.empty else float(np.sqrt(means.min()))


Figures = Mapping[str, Mapping[str, Any]]
"""By source the figures of TransferResult."""

_PANELS: Final = (
    ("false", "false claims [%]", 20.0),
    ("found", "real differences found [%]", 50.0),
)
"""Figure, label, and the aim (%)."""


def transfer_figure(path: Path, figures: Figures, width: float = WIDTH) -> Path:
    """Draw the shares of each source into a .pdf, .png or .svg file, the same bytes every time;
    the dashed line is the aim. Raises UsageError for another suffix."""
    return write_figure(lambda: _draw_transfer(figures, width), path)


def _draw_transfer(figures: Figures, width: float) -> "Figure":
    sources = list(figures)
    picture = new_figure(0.6 + 0.14 * len(sources), width)
    panels = picture.subplots(1, 2, sharey=True)
    for axes, (word, label, aim) in zip(panels, _PANELS, strict=True):
        _shares(axes, [figures[source][word] for source in sources])
        axes.axvline(aim, color=COLOURS[6], linewidth=0.5, linestyle="--")
        axes.set_xlabel(label)
        axes.set_xlim(-4, 104)
        axes.spines[["top", "right"]].set_visible(False)
    panels[0].set_yticks(range(len(sources)), [plain(source) for source in sources])
    panels[0].invert_yaxis()
    return picture


def _shares(axes: "Axes", shares: Sequence[Mapping[str, Any]]) -> None:
    for k, share in enumerate(shares):
        if share["value"] is None:
            continue
        axes.plot(100 * share["value"], k, "o", color=COLOURS[0])
        if share["low"] is not None:
            axes.plot([100 * share["low"], 100 * share["high"]], [k, k], color=COLOURS[0])
