"""A table as a picture for a two-column paper: dots with intervals, or a heat map."""

import io
import math
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sysid_bench.errors import UsageError
from sysid_bench.reporting.notation import ABSENT
from sysid_bench.reporting.tables import Entry, Key, Table

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

WIDTH: Final = 3.5  # inches, one column of a two-column paper
_INK, _GREY = "#222222", "#8a8a8a"
# Distinct in print, on screen and for colour-blind readers (Okabe and Ito, 2008).
COLOURS: Final = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#56b4e9", "#e69f00", "#000000")
_MARKERS: Final = ("o", "s", "D", "^", "v", "P", "X")
STYLE: Final[dict[Any, Any]] = {
    "font.family": "STIXGeneral", "mathtext.fontset": "stix", "font.size": 8,
    "axes.labelsize": 8, "xtick.labelsize": 7, "ytick.labelsize": 7, "legend.fontsize": 7,
    "axes.linewidth": 0.5, "xtick.major.width": 0.5, "ytick.major.width": 0.5,
    "xtick.minor.width": 0.3, "lines.linewidth": 0.8, "lines.markersize": 3.2,
    "text.color": _INK, "axes.labelcolor": _INK, "xtick.color": _INK, "ytick.color": _INK,
    "axes.edgecolor": _INK, "pdf.fonttype": 42, "ps.fonttype": 42,
    "svg.fonttype": "path", "svg.hashsalt": "sysid_bench",
}  # fmt: skip
# A file that says when it was made would differ every time.
METADATA: Final[Mapping[str, dict[str, None]]] = {
    "pdf": {"CreationDate": None, "ModDate": None, "Producer": None, "Creator": None},
    "svg": {"Date": None, "Creator": None},
}
_DECADES_FOR_LOG = 1.5
LONGEST: Final = 40  # letters of a label


def figure(table: Table, path: Path) -> Path:
    """Draws a table into a .pdf or .svg file, the same bytes every time.

    A heat map where one field meets one field and neither is the estimator (robot x payload),
    dots with intervals otherwise. Raises UsageError for another suffix.
    """
    return write_figure(lambda: _picture(table), path)


def figure_svg(table: Table) -> str:
    """The same picture as an <svg> element to put into a page."""
    return svg_element(figure_bytes(lambda: _picture(table), "svg"))


def write_figure(draw: "Callable[[], Figure]", path: Path) -> Path:
    """A drawing as a .pdf or .svg file; raises UsageError for another suffix."""
    kind = path.suffix.lower().removeprefix(".")
    if kind not in METADATA:
        raise UsageError(f"A figure ends with .pdf or .svg; {path.name!r} does not.")
    path.write_bytes(figure_bytes(draw, kind))
    return path


def svg_element(svg: bytes) -> str:
    """The <svg> element of a file."""
    text = svg.decode()
    return re.sub(r"<metadata>.*?</metadata>\s*", "", text[text.index("<svg") :], flags=re.DOTALL)


def figure_bytes(draw: "Callable[[], Figure]", kind: str) -> bytes:
    """A drawing as the bytes of a file, in the style of this package, not of the user."""
    import matplotlib

    with matplotlib.rc_context(rc={**matplotlib.rcParamsDefault, **STYLE}):
        out = io.BytesIO()
        draw().savefig(
            out, format=kind, metadata=METADATA[kind], bbox_inches="tight", pad_inches=0.02
        )
    return out.getvalue()


def _picture(table: Table) -> "Figure":
    fields = (*table.row_fields, *table.column_fields)
    map_like = len(table.row_fields) == len(table.column_fields) == 1
    return _heat_map(table) if map_like and "estimator" not in fields else _dots(table)


def _dots(table: Table) -> "Figure":
    from matplotlib.figure import Figure

    lanes = max(len(table.columns), 1)
    step = 0.06 + 0.075 * lanes
    height = max(0.9 + step * len(table.rows), 1.3)
    drawing = Figure(figsize=(WIDTH, height), layout="constrained")
    axes = drawing.add_subplot()
    logarithmic = _spans_decades(table)
    axes.set_xscale("log" if logarithmic else "linear")
    for lane, column in enumerate(table.columns):
        offset = ((lane + 0.5) / lanes - 0.5) * 0.72
        _one_series(axes, table, column, lane, offset, logarithmic)
    axes.set_yticks(range(len(table.rows)), [_label(" · ".join(row)) for row in table.rows])
    axes.set_ylim(len(table.rows) - 0.5, -0.5)
    axes.set_xlabel(plain(table.metric.heading))
    axes.grid(axis="x", which="major", color="#dddddd", linewidth=0.4)
    axes.set_axisbelow(True)
    _separate(axes, table)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    axes.tick_params(axis="y", length=0)
    if axes.get_legend_handles_labels()[0] and table.column_fields:
        drawing.legend(loc="outside upper center", ncols=min(lanes, 2), frameon=False,
                       handletextpad=0.3, columnspacing=1.0, borderaxespad=0.2)  # fmt: skip
    return drawing


def _one_series(
    axes: "Axes", table: Table, column: Key, lane: int, offset: float, logarithmic: bool
) -> None:
    colour, marker = COLOURS[lane % len(COLOURS)], _MARKERS[lane % len(_MARKERS)]
    xs, ys = [], []
    for i, row in enumerate(table.rows):
        entry = table.entry(row, column)
        if entry is None:
            continue
        if entry.value is None or (logarithmic and entry.value <= 0):
            _absent(axes, entry, i + offset, colour)
            continue
        xs.append(entry.value)
        ys.append(i + offset)
        if entry.low is not None and entry.high is not None:
            low = entry.value if logarithmic and entry.low <= 0 else entry.low
            axes.plot([low, entry.high], [i + offset] * 2, color=colour, solid_capstyle="butt")
    name = plain(" · ".join(column)) or None
    axes.plot(xs, ys, marker, color=colour, markeredgewidth=0, label=name)


def _absent(axes: "Axes", entry: Entry, y: float, colour: str) -> None:
    """A failure stands as a word at the left edge; a zero on a log axis as 0."""
    word = "0" if entry.value is not None else (entry.label or "no value")
    axes.text(0.01, y, plain(word), transform=axes.get_yaxis_transform(), color=colour,
              fontsize=5.5, fontstyle="italic", va="center")  # fmt: skip


def _separate(axes: "Axes", table: Table) -> None:
    """A line between groups of the first row field."""
    for i in range(1, len(table.rows)):
        if len(table.row_fields) > 1 and table.rows[i][0] != table.rows[i - 1][0]:
            axes.axhline(i - 0.5, color="#bbbbbb", linewidth=0.5)


def _heat_map(table: Table) -> "Figure":
    from matplotlib.figure import Figure

    values = np.array([[_log(table.entry(r, c)) for c in table.columns] for r in table.rows])
    drawing = Figure(figsize=(WIDTH, 0.7 + 0.24 * len(table.rows)), layout="constrained")
    axes = drawing.add_subplot()
    known = values[np.isfinite(values)]
    low = math.floor(known.min()) if len(known) else 0
    # Four decades at least: differences within rounding must not look like differences.
    high = max(math.ceil(known.max()) if len(known) else 0, low + 4)
    axes.set_facecolor("#eeeeee")
    shades = np.ma.masked_invalid(values)
    axes.pcolormesh(shades, cmap="Blues", vmin=low, vmax=high, edgecolors="white", linewidth=1)
    axes.invert_yaxis()
    for i, row in enumerate(table.rows):
        for j, column in enumerate(table.columns):
            dark = values[i, j] > low + 0.6 * (high - low)
            text = plain(_cell_text(table, row, column))
            axes.text(j + 0.5, i + 0.5, text, ha="center", va="center", fontsize=6.5,
                      color="white" if dark else _INK)  # fmt: skip
    axes.set_xticks(np.arange(len(table.columns)) + 0.5, [_label(c[0]) for c in table.columns])
    axes.set_yticks(np.arange(len(table.rows)) + 0.5, [_label(r[0]) for r in table.rows])
    axes.set_xlabel(plain(table.column_fields[0]))
    axes.set_title(plain(table.metric.heading), fontsize=8)
    axes.tick_params(length=0)
    for side in axes.spines.values():
        side.set_visible(False)
    return drawing


def _cell_text(table: Table, row: Key, column: Key) -> str:
    entry = table.entry(row, column)
    if entry is None:
        return ABSENT
    if entry.value is None:
        return entry.label or ABSENT
    digits = f"{entry.value:.0e}" if entry.value else "0"
    return digits.replace("e-0", "e-").replace("e+0", "e+") + ("*" if entry.note else "")


def _log(entry: Entry | None) -> float:
    if entry is None or entry.value is None or entry.value <= 0:
        return math.nan
    return math.log10(entry.value)


def _spans_decades(table: Table) -> bool:
    values = [entry.value for entry in table.entries.values() if entry.value is not None]
    positive = [value for value in values if value > 0]
    if not positive or any(value < 0 for value in values):
        return False
    return math.log10(max(positive)) - math.log10(min(positive)) > _DECADES_FOR_LOG


def _label(text: str) -> str:
    """A name, shortened to its two ends where it is long."""
    half = LONGEST // 2
    return plain(text if len(text) <= LONGEST else f"{text[:half]}...{text[-half:]}")


def plain(text: str) -> str:
    """Text that prints as it is. Names come from users: a dollar sign starts no formula, an odd
    letter needs no font."""
    known = "".join(c if c == ABSENT or (c.isprintable() and ord(c) < 0x370) else "?" for c in text)
    return known.replace("$", r"\$")
