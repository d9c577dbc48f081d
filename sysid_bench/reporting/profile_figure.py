"""Profiles of errors for a two-column paper: those of Dolan and More (2002), with a reference named
beforehand in place of the best of each case, so that no curve depends on the others."""

from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np

from sysid_bench.reporting.figure_files import (
    COLOURS,
    WIDTH,
    new_figure,
    plain,
    svg_of,
    write_figure,
)
from sysid_bench.reporting.ranking import RATIOS, Ranking

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

NAMED: Final = len(COLOURS)
"""Methods that have a colour and a name, the first of the order; the others are grey."""

_DASHES: Final = ("-", "--")


def profile(ranking: Ranking, path: Path, width: float = WIDTH) -> Path:
    """Draw a profile (width in inches) into a .pdf, .png or .svg file, the same bytes always."""
    return write_figure(lambda: _figure(ranking, width), path)


def profile_svg(ranking: Ranking) -> str:
    """The same picture as an <svg> element to put into a page."""
    return svg_of(lambda: _figure(ranking, WIDTH))


def _figure(ranking: Ranking, width: float) -> "Figure":
    drawing = new_figure(2.6, width)
    axes = drawing.add_subplot()
    for rank in reversed(range(len(ranking.method_names))):  # the first on top
        _line(axes, ranking, rank)
    axes.set_xscale("log")
    axes.set_xlim(RATIOS[0], RATIOS[-1])
    axes.set_ylim(-0.01, 1.01)
    ticks = [0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 50, 100]
    axes.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
    axes.minorticks_off()
    axes.set_xlabel(plain(f"Times {ranking.against}: {ranking.metric.title.lower()}"))
    axes.set_ylabel("Share of cases within")
    axes.grid(which="major", color="#dddddd", linewidth=0.4)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    handles, names = axes.get_legend_handles_labels()
    drawing.legend(handles[::-1], names[::-1], loc="outside right upper", frameon=False,
                   handlelength=1.6, handletextpad=0.4, borderaxespad=0.2)  # fmt: skip
    return drawing


def _line(axes: "Axes", ranking: Ranking, rank: int) -> None:
    share = ranking.profile[:, rank]
    if rank >= NAMED:
        # One of the grey lines names them all.
        others = "others" if rank == NAMED else None
        axes.step(RATIOS, share, where="post", color="#cccccc", linewidth=0.5, label=others)
        return
    colour, dashes = COLOURS[rank], _DASHES[rank % 2]
    name = plain(ranking.method_names[rank])
    axes.step(RATIOS, np.asarray(share), dashes, where="post", color=colour, label=name)
