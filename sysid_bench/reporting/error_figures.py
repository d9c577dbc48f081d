"""Figures of errors: against the length of the training, and of simulation beside reality."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import chain
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sysid_bench.reporting.figures import COLOURS, DOUBLE, WIDTH, Drawing, new_figure, plain
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


@Drawing
def size_figure(sizes: tuple[SizeErrors, ...], width: float = DOUBLE) -> "Figure":
    """Draw errors against lengths, the curves of each robot on axes of its own."""
    lines = -(-len(sizes) // COLUMNS)
    picture = new_figure(1.2 * lines + 0.35, width)
    grid = picture.subplots(lines, COLUMNS, squeeze=False)
    methods = list(dict.fromkeys(chain.from_iterable(one.errors for one in sizes)))
    drawn: dict[str, Line2D] = {}
    for axes, one in zip(grid.ravel(), sizes, strict=False):
        for name, errors in one.errors.items():
            shown = {s: errors[s] for s in sorted(errors) if errors[s] < LARGEST}
            k = methods.index(name) % len(COLOURS)
            (drawn[name],) = axes.loglog(
                list(shown), list(shown.values()), "osD^vPX"[k] + "-", color=COLOURS[k]
            )
        if one.floor is not None:
            drawn["floor"] = axes.axhline(one.floor, color=COLOURS[6], linestyle=":")
        _label(axes, one)
        axes.spines[["top", "right"]].set_visible(False)
    for axes in grid.ravel()[len(sizes) :]:
        axes.set_axis_off()
    for axes in grid[-1]:
        axes.set_xlabel("training [s]")
    for axes in grid[:, 0]:
        axes.set_ylabel("torque error")
    names = [name for name in (*methods, "floor") if name in drawn]
    handles = [drawn[name] for name in names]
    picture.legend(handles, names, ncols=len(names), loc="outside upper right", frameon=False)
    return picture


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


DRAWN: Final = ("wls", "lmi", "entropic", "a-priori")
"""Methods in the figure of training lengths."""


def size_errors(cells: "pd.DataFrame", joints: "pd.DataFrame") -> tuple[SizeErrors, ...]:
    """Return the errors of DRAWN methods by the length of the training, robot by robot."""
    found = []
    for name, every in cells.groupby("robot", sort=False):
        lengths = every.groupby("pipeline")["log.seconds"].nunique()
        # One pipeline, that with the most lengths: a curve over several would show their
        # differences.
        part = every[every["pipeline"] == lengths.idxmax()]
        drawn = {}
        for method in DRAWN:
            rows = part.loc[part["estimator"] == method, ["log.seconds", "torque_error"]]
            pairs = rows.astype(float).itertuples(index=False, name=None)
            if points := {seconds: error for seconds, error in pairs if math.isfinite(error)}:
                drawn[method] = points
        found.append(SizeErrors(str(name), drawn, floor_of(cells_of_motions(part), joints)))
    return tuple(found)


def cells_of_motions(cells: "pd.DataFrame") -> "pd.DataFrame":
    """Return the cells with whole training motions: the longest of each robot."""
    longest = cells.groupby("robot")["log.seconds"].transform("max")
    # Pipelines leave out different ends of a motion: nearly the longest is the whole.
    return cells[cells["log.seconds"] >= 0.9 * longest]


def floor_of(cells: "pd.DataFrame", joints: "pd.DataFrame") -> float | None:
    """Return the RMS over joints of the error of repeating the training torque; None where the test
    is another motion."""
    wanted = cells.loc[cells["estimator"] == REFERENCE, "id"]
    # Joints of small torque are left out here as in the torque error that the floor stands beside.
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


@Drawing
def transfer_figure(figures: Figures, width: float = WIDTH) -> "Figure":
    """Draw the shares of each source; the dashed line is the aim."""
    sources = list(figures)
    picture = new_figure(0.6 + 0.14 * len(sources), width)
    panels = picture.subplots(1, 2, sharey=True)
    for axes, (word, label, aim) in zip(panels, _PANELS, strict=True):
        for k, source in enumerate(sources):
            share = figures[source][word]
            if share["value"] is None:
                continue
            axes.plot(100 * share["value"], k, "o", color=COLOURS[0])
            if share["low"] is not None:
                axes.plot([100 * share["low"], 100 * share["high"]], [k, k], color=COLOURS[0])
        axes.axvline(aim, color=COLOURS[6], linewidth=0.5, linestyle="--")
        axes.set_xlabel(label)
        axes.set_xlim(-4, 104)
        axes.spines[["top", "right"]].set_visible(False)
    panels[0].set_yticks(range(len(sources)), [plain(source) for source in sources])
    panels[0].invert_yaxis()
    return picture
