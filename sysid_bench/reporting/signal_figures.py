"""Figures of signals: torques, curves and spectra along a log; differences of two regressors."""

import io
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import groupby
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sysid_bench.reporting.figures import (
    COLOURS,
    DOUBLE,
    METADATA,
    STYLE,
    Drawing,
    new_figure,
    plain,
)
from sysid_bench.types import Array, CellData, Curve

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


HEIGHT: Final = 1.1  # inches a joint
_WIDE: Final = 5.0
"""Inches from which residuals stand beside the torques, and not below them."""


@dataclass(frozen=True, eq=False)
class StoredTorque:
    """Torques along a test log that a cell stored: t (N,) in s, measured and predicted (N, rows)
    with a name and a unit for each row, and the title of the figure."""

    title: str
    t: Array
    measured: Array
    predicted: Array
    rows: tuple[str, ...]
    units: tuple[str, ...]


@Drawing
def torque_figure(sample: StoredTorque, width: float = DOUBLE) -> "Figure":
    """Draw measured and predicted torques; residuals have an axis of their own."""
    count, is_wide = len(sample.rows), width > _WIDE
    picture = new_figure(HEIGHT * count * (1.0 if is_wide else 1.5) + 0.4, width)
    if is_wide:
        grid = picture.subplots(count, 2, sharex=True, squeeze=False, width_ratios=[3, 2])
    else:
        heights = [2, 1] * count
        stacked = picture.subplots(2 * count, 1, sharex=True, squeeze=False, height_ratios=heights)
        grid = stacked.reshape(count, 2)
    for i, (torques, residuals) in enumerate(grid):
        measured, predicted = sample.measured[:, i], sample.predicted[:, i]
        torques.plot(sample.t, measured, color=COLOURS[0], label="measured")
        torques.plot(sample.t, predicted, "--", color=COLOURS[1], label="predicted")
        residuals.plot(sample.t, measured - predicted, color=COLOURS[6], linewidth=0.5)
        torques.set_ylabel(f"{plain(sample.rows[i])} [{plain(sample.units[i])}]")
        residuals.set_ylabel("residual")
        for axes in (torques, residuals):
            axes.margins(x=0)
            axes.spines[["top", "right"]].set_visible(False)
    for axes in grid[-1] if is_wide else grid[-1, 1:]:
        axes.set_xlabel("time [s]")
    lines, names = grid[0, 0].get_legend_handles_labels()
    picture.legend(lines, names, ncols=2, loc="outside upper right", frameon=False)
    return picture


_HEIGHT: Final = 0.85  # inches an axis
_COLUMNS: Final = 2


@dataclass(frozen=True, eq=False)
class StoredCurves:
    """Curves that a cell stored, and the title of their figure."""

    title: str
    curves: tuple[Curve, ...]


@Drawing
def curve_figure(sample: StoredCurves, width: float = DOUBLE) -> "Figure":
    """Draw curves, two beside each other; a name has one colour on all axes."""
    rows = -(-len(sample.curves) // _COLUMNS)
    picture = new_figure(_HEIGHT * rows + 0.5, width)
    grid = picture.subplots(rows, _COLUMNS, sharex=True, squeeze=False)
    names = list(dict.fromkeys(name for curve in sample.curves for name in curve.series))
    lines: dict[str, Any] = {}
    for axes, curve in zip(grid.flat, sample.curves, strict=False):
        for name, values in curve.series.items():
            colour = COLOURS[names.index(name) % len(COLOURS)]
            (lines[name],) = axes.plot(curve.t, values, color=colour)
        _frame_curve(axes, curve)
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


def _frame_curve(axes: "Axes", curve: Curve) -> None:
    """Limits, name and unit of a curve."""
    for limit in curve.limits or ():
        axes.axhline(limit, color="#bbbbbb", linestyle="--", linewidth=0.6)
    if curve.unit:
        axes.set_ylabel(f"{plain(curve.name)} [{plain(curve.unit)}]")
    else:
        axes.set_title(plain(curve.name), loc="left", fontsize=7, pad=2)
    axes.margins(x=0)
    axes.spines[["top", "right"]].set_visible(False)


COLUMNS: Final = 4
"""Joints side by side."""


@dataclass(frozen=True, eq=False)
class ResidualSpectra:
    """Frequencies f (m,) in Hz and, by source, the density (m, n) of the residual of n joints, in
    (N m)^2/Hz or N^2/Hz."""

    joints: tuple[str, ...]
    f: Array
    densities: Mapping[str, Array]


@Drawing
def spectra_figure(spectra: ResidualSpectra, width: float = DOUBLE) -> "Figure":
    """Draw the spectra of each joint."""
    count, styles = len(spectra.joints), ("-", "--", ":")
    lines = -(-count // COLUMNS)
    picture = new_figure(1.25 * lines + 0.35, width)
    grid = picture.subplots(lines, COLUMNS, sharex=True, squeeze=False)
    for axes in grid.ravel()[count:]:
        axes.set_axis_off()
    for j, axes in enumerate(grid.ravel()[:count]):
        for k, (source, density) in enumerate(spectra.densities.items()):
            axes.loglog(spectra.f, density[:, j], styles[k % 3], color=COLOURS[k],
                        label=plain(source))  # fmt: skip
        axes.set_title(plain(spectra.joints[j]), fontsize=7)
        axes.spines[["top", "right"]].set_visible(False)
    for axes in grid[-1]:
        axes.set_xlabel("frequency [Hz]")
    handles, names = grid[0, 0].get_legend_handles_labels()
    picture.legend(handles, names, ncols=len(names), loc="outside upper right", frameon=False)
    return picture


_PAPER, _INK, _LINE = "#0d0d0d", "#e4e8ee", "#555555"
_SIZE, _DPI = (1.5, 5.6), 250  # inches, dots per inch: about the pixels of its view
_MOST_ROWS, _MOST_BODIES = 12, 24
"""Names along a side; of more, some are left out evenly."""
_DECADES: Final = (4, 6)  # rounding has no pattern; one entry of 1e-30 hides the others


def difference_figure(cell: CellData) -> bytes:
    """A picture of log10 |Y - Y_pin| (rows, parameters), PNG: rows by name, parameters by body;
    entries without a difference have no colour."""
    import matplotlib

    colours = ("text.color", "axes.labelcolor", "xtick.color", "ytick.color", "axes.edgecolor")
    style = {**STYLE, **dict.fromkeys(colours, _INK), "figure.facecolor": _PAPER}
    with matplotlib.rc_context(rc={**matplotlib.rcParamsDefault, **style}):
        out = io.BytesIO()
        drawing = new_figure(*_SIZE)
        axes = drawing.add_subplot()
        sizes = np.abs(np.asarray(cell.gap_map, dtype=float))
        with np.errstate(divide="ignore"):
            # Entries without a difference are masked: the lowest colour would say that there is
            # one.
            values = np.ma.masked_invalid(np.log10(sizes))
        high = float(values.max()) if values.count() else 0.0
        least = float(values.min()) if values.count() else 0.0
        low = high - float(np.clip(high - least, *_DECADES))
        axes.set_facecolor("#1c2229")
        shades = axes.pcolormesh(values, cmap="viridis", vmin=low, vmax=high)
        axes.invert_yaxis()
        names = [name or f"row{i}" for i, name in enumerate(cell.rows)][: cell.gap_map.shape[0]]
        step = -(-len(names) // _MOST_ROWS)
        places = np.arange(len(names))[::step]
        axes.set_yticks(places + 0.5, [plain(names[i]) for i in places], fontsize=5)
        _name_bodies(axes, cell)
        axes.tick_params(length=0)
        extend = "min" if least < low else "neither"
        drawing.colorbar(shades, ax=axes, label="log10 |Y - Y_pin|", pad=0.01, extend=extend)
        drawing.savefig(out, format="png", dpi=_DPI, metadata=METADATA["png"])
    return out.getvalue()


def _name_bodies(axes: "Axes", cell: CellData) -> None:
    """The body of each group of parameters below it, and a line between groups."""
    owners = [name.rpartition(".")[0] or name for name in cell.gap_columns]
    groups = [(owner, len(list(group))) for owner, group in groupby(owners)]
    ends = np.cumsum([count for _, count in groups])
    step = -(-len(groups) // _MOST_BODIES)
    for end in ends[:-1]:
        axes.axvline(end, color=_LINE, linewidth=0.3)
    middles = ends - np.array([count for _, count in groups]) / 2
    names = [plain(owner) for owner, _ in groups]
    axes.set_xticks(middles[::step], names[::step], fontsize=5, rotation=35, ha="right",
                    rotation_mode="anchor")  # fmt: skip
