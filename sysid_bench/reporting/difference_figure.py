"""Map of the differences of two regressors with names and a colour scale, for a dark viewer."""

import io
from itertools import groupby
from typing import TYPE_CHECKING, Final

import numpy as np

from sysid_bench.reporting.figure_files import METADATA, STYLE, new_figure, plain
from sysid_bench.types import CellData

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_PAPER, _INK, _LINE = "#0d0d0d", "#e4e8ee", "#555555"
_WIDTH, _HEIGHT, _DPI = 5.6, 1.5, 250  # inches, dots per inch: about the pixels of its view
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
        _figure(cell).savefig(out, format="png", dpi=_DPI, metadata=METADATA["png"])
    return out.getvalue()


def _figure(cell: CellData) -> "Figure":
    drawing = new_figure(_HEIGHT, _WIDTH)
    axes = drawing.add_subplot()
    sizes = np.abs(np.asarray(cell.gap_map, dtype=float))
    with np.errstate(divide="ignore"):
        values = np.ma.masked_invalid(np.log10(sizes))
    high = float(values.max()) if values.count() else 0.0
    least = float(values.min()) if values.count() else 0.0
    low = high - float(np.clip(high - least, *_DECADES))
    axes.set_facecolor("#1c2229")
    shades = axes.pcolormesh(values, cmap="viridis", vmin=low, vmax=high)
    axes.invert_yaxis()
    _name_rows(axes, cell)
    _name_bodies(axes, cell)
    axes.tick_params(length=0)
    extend = "min" if least < low else "neither"
    drawing.colorbar(shades, ax=axes, label="log10 |Y - Y_pin|", pad=0.01, extend=extend)
    return drawing


def _name_rows(axes: "Axes", cell: CellData) -> None:
    names = [name or f"row{i}" for i, name in enumerate(cell.rows)][: cell.gap_map.shape[0]]
    step = -(-len(names) // _MOST_ROWS)
    places = np.arange(len(names))[::step]
    axes.set_yticks(places + 0.5, [plain(names[i]) for i in places], fontsize=5)


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
