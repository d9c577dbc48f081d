"""Spectra of residuals of a robot and of its twins, joint by joint."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final

from sysid_bench.reporting.figure_files import COLOURS, DOUBLE, new_figure, plain, write_figure
from sysid_bench.types import Array

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

COLUMNS: Final = 4
"""Joints side by side."""


@dataclass(frozen=True, eq=False)
class ResidualSpectra:
    """Frequencies f (m,) in Hz and, by source, the density (m, n) of the residual of n joints, in
    (N m)^2/Hz or N^2/Hz."""

    joints: tuple[str, ...]
    f: Array
    densities: Mapping[str, Array]


def spectra_figure(path: Path, spectra: ResidualSpectra, width: float = DOUBLE) -> Path:
    """Draw spectra into a .pdf, .png or .svg file, the same bytes every time. Raises UsageError for
    another suffix."""
    return write_figure(lambda: _picture(spectra, width), path)


def _picture(spectra: ResidualSpectra, width: float) -> "Figure":
    count = len(spectra.joints)
    lines = -(-count // COLUMNS)
    picture = new_figure(1.25 * lines + 0.35, width)
    grid = picture.subplots(lines, COLUMNS, sharex=True, squeeze=False)
    for j, axes in enumerate(grid.ravel()):
        if j >= count:
            axes.set_axis_off()
            continue
        _joint(axes, spectra, j)
    for axes in grid[-1]:
        axes.set_xlabel("frequency [Hz]")
    handles, names = grid[0, 0].get_legend_handles_labels()
    picture.legend(handles, names, ncols=len(names), loc="outside upper right", frameon=False)
    return picture


def _joint(axes: "Axes", spectra: ResidualSpectra, j: int) -> None:
    styles: Sequence[str] = ("-", "--", ":")
    for k, (source, density) in enumerate(spectra.densities.items()):
        axes.loglog(spectra.f, density[:, j], styles[k % 3], color=COLOURS[k], label=plain(source))
    axes.set_title(plain(spectra.joints[j]), fontsize=7)
    axes.spines[["top", "right"]].set_visible(False)
