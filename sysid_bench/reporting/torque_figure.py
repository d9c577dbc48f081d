"""Measured and predicted torque of every joint, and their difference, as papers show them."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Final

from sysid_bench.reporting.figures import new_figure, svg_of, write_figure
from sysid_bench.types import Array

if TYPE_CHECKING:
    from matplotlib.figure import Figure

WIDTH: Final = 7.16  # inches, both columns of a two-column paper
HEIGHT: Final = 1.1  # inches a joint


def torque_figure(
    path: Path,
    t: Array,
    rows: Sequence[str],
    measured: Array,
    predicted: Array,
    units: Sequence[str],
) -> Path:
    """Draw t (N,), measured and predicted (N, rows) into a .pdf or .svg file, the same bytes every
    time; the error is dashed. Raises UsageError for another suffix."""
    return write_figure(lambda: _figure(t, rows, measured, predicted, units), path)


def torque_svg(
    t: Array, rows: Sequence[str], measured: Array, predicted: Array, units: Sequence[str]
) -> str:
    """Draw the same figure as an <svg> element to put into a page."""
    return svg_of(lambda: _figure(t, rows, measured, predicted, units))


def _figure(
    t: Array, rows: Sequence[str], measured: Array, predicted: Array, units: Sequence[str]
) -> "Figure":
    picture = new_figure(HEIGHT * len(rows) + 0.4, WIDTH)
    for i, axes in enumerate(picture.subplots(len(rows), 1, sharex=True, squeeze=False)[:, 0]):
        axes.plot(t, measured[:, i], color="#0072b2", label="measured")
        axes.plot(t, predicted[:, i], color="#d55e00", label="predicted")
        axes.plot(t, measured[:, i] - predicted[:, i], "--", color="#8a8a8a", label="error")
        axes.set_ylabel(f"{rows[i]} [{units[i]}]")
        axes.margins(x=0)
    axes.set_xlabel("time [s]")
    lines, names = picture.axes[0].get_legend_handles_labels()
    picture.legend(lines, names, ncols=3, loc="outside upper right", frameon=False)
    return picture
