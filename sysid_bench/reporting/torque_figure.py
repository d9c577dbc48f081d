"""Measured and predicted torque of every joint, and their difference, as papers show them."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final

from sysid_bench.reporting.figure_files import (
    COLOURS,
    DOUBLE,
    new_figure,
    plain,
    svg_of,
    write_figure,
)
from sysid_bench.types import Array

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


def torque_figure(path: Path, sample: StoredTorque, width: float = DOUBLE) -> Path:
    """Draw torques (width in inches) into a .pdf, .png or .svg file, the same bytes every time;
    residuals have an axis of their own. Raises UsageError for another suffix."""
    return write_figure(lambda: _figure(sample, width), path)


def torque_svg(sample: StoredTorque) -> str:
    """Draw the same figure as an <svg> element to put into a page."""
    return svg_of(lambda: _figure(sample, DOUBLE))


def _figure(sample: StoredTorque, width: float) -> "Figure":
    count, is_wide = len(sample.rows), width > _WIDE
    picture = new_figure(HEIGHT * count * (1.0 if is_wide else 1.5) + 0.4, width)
    if is_wide:
        grid = picture.subplots(count, 2, sharex=True, squeeze=False, width_ratios=[3, 2])
    else:
        heights = [2, 1] * count
        stacked = picture.subplots(2 * count, 1, sharex=True, squeeze=False, height_ratios=heights)
        grid = stacked.reshape(count, 2)
    for i, (torques, residuals) in enumerate(grid):
        _joint(torques, residuals, sample, i)
    for axes in grid[-1] if is_wide else grid[-1, 1:]:
        axes.set_xlabel("time [s]")
    lines, names = grid[0, 0].get_legend_handles_labels()
    picture.legend(lines, names, ncols=2, loc="outside upper right", frameon=False)
    return picture


def _joint(torques: "Axes", residuals: "Axes", sample: StoredTorque, i: int) -> None:
    """Measured and predicted torque of a joint, and their difference on the other axes."""
    measured, predicted = sample.measured[:, i], sample.predicted[:, i]
    torques.plot(sample.t, measured, color=COLOURS[0], label="measured")
    torques.plot(sample.t, predicted, "--", color=COLOURS[1], label="predicted")
    residuals.plot(sample.t, measured - predicted, color=COLOURS[6], linewidth=0.5)
    torques.set_ylabel(f"{plain(sample.rows[i])} [{plain(sample.units[i])}]")
    residuals.set_ylabel("residual")
    for axes in (torques, residuals):
        axes.margins(x=0)
        axes.spines[["top", "right"]].set_visible(False)
