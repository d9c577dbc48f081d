"""Figures of a two-column paper and of pages; a table as dots with intervals, or as a heat map."""

import io
import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import accumulate, product
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Generic, ParamSpec

import numpy as np

from sysid_bench.errors import UsageError
from sysid_bench.reporting.baseline_rows import BASELINES
from sysid_bench.reporting.tables import ABSENT, NO_ENTRY, Entry, Key, Table

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

P = ParamSpec("P")

WIDTH: Final = 3.44  # inches; with its margin, one column of a two-column paper (252 pt)
DOUBLE: Final = 7.1  # inches, both columns (516 pt)
FINE, COARSE = 300, 90
"""Dots per inch of PNG files of one column, and of both, which then have less than 100 kB."""

INK: Final = "#222222"
# Distinct in print, on screen and for colour-blind readers (Okabe and Ito, 2008).
COLOURS: Final = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#56b4e9", "#e69f00", "#000000")
STYLE: Final[dict[Any, Any]] = {
    "font.family": "STIXGeneral", "mathtext.fontset": "stix", "font.size": 8,
    "axes.labelsize": 8, "xtick.labelsize": 7, "ytick.labelsize": 7, "legend.fontsize": 7,
    "axes.linewidth": 0.5, "xtick.major.width": 0.5, "ytick.major.width": 0.5,
    "xtick.minor.width": 0.3, "lines.linewidth": 0.8, "lines.markersize": 3.2,
    "text.color": INK, "axes.labelcolor": INK, "xtick.color": INK, "ytick.color": INK,
    "axes.edgecolor": INK, "pdf.fonttype": 42, "ps.fonttype": 42,
    "svg.fonttype": "path", "svg.hashsalt": "sysid_bench",
}  # fmt: skip
# A file that says when it was made would differ every time.
METADATA: Final[Mapping[str, dict[str, None]]] = {
    "pdf": {"CreationDate": None, "ModDate": None, "Producer": None, "Creator": None},
    "svg": {"Date": None, "Creator": None},
    "png": {"Software": None},
}
_OF_PAGE: Final = {
    INK: "ink", "#000000": "ink", "#ffffff": "page", "#dddddd": "line", "#bbbbbb": "line",
}  # fmt: skip
"""Variables of a page in place of colours that are right on white paper alone."""


class Drawing(Generic[P]):
    """Decorator of functions that draw data at a width (inches): the same bytes every time."""

    def __init__(self, draw: "Callable[P, Figure]") -> None:
        self.draw = draw

    def write(self, path: Path, /, *data: P.args, **words: P.kwargs) -> Path:
        """Draw into a .pdf, .png or .svg file; raises UsageError for another suffix."""
        kind = path.suffix.lower().removeprefix(".")
        if kind not in METADATA:
            raise UsageError(f"A figure ends with .pdf, .png or .svg; {path.name!r} does not.")
        path.write_bytes(_file_bytes(partial(self.draw, *data, **words), kind))
        return path

    def svg(self, *data: P.args, **words: P.kwargs) -> str:
        """Draw as an <svg> element of a page."""
        return svg_element(_file_bytes(partial(self.draw, *data, **words), "svg"))


def svg_element(svg: bytes) -> str:
    """The <svg> element of a file."""
    text = svg.decode()
    return re.sub(r"<metadata>.*?</metadata>\s*", "", text[text.index("<svg") :], flags=re.DOTALL)


def page_svg(svg: str) -> str:
    """The element with ink, lines and paper of the page that it stands in, light or dark."""
    for colour, variable in _OF_PAGE.items():
        svg = svg.replace(colour, f"var(--{variable})")
    return svg


def new_figure(height: float, width: float = WIDTH) -> "Figure":
    """An empty figure; height and width in inches."""
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), layout="constrained")


def _file_bytes(draw: "Callable[[], Figure]", kind: str) -> bytes:
    """A drawing as the bytes of a file, in the style of this package, not of the user."""
    import matplotlib

    with matplotlib.rc_context(rc={**matplotlib.rcParamsDefault, **STYLE}):
        out, picture = io.BytesIO(), draw()
        dpi = FINE if picture.get_figwidth() <= WIDTH else COARSE
        picture.savefig(
            out, format=kind, metadata=METADATA[kind], bbox_inches="tight", pad_inches=0.02, dpi=dpi
        )
    return out.getvalue()


def plain(text: str) -> str:
    """Text that prints as it is. Names come from users: a dollar sign starts no formula, an odd
    letter needs no font."""
    # Every font of matplotlib has the letters before Greek, from 0x370 on.
    known = (c == ABSENT or (c.isprintable() and ord(c) < 0x370) for c in text)
    shown = "".join(c if has_glyph else "?" for c, has_glyph in zip(text, known, strict=True))
    return shown.replace("$", r"\$")


EXACT: Final = "exact"
"""Label of noise-free cells: their errors are rounding, and stand on an axis of their own."""

# Letters on a shade of a map, whose colours are the same on every page.
_ON_LIGHT, _ON_DARK = "#222223", "#fffffe"
_MARKERS: Final = ("o", "s", "D", "^", "v", "P", "X")
_DECADES_FOR_LOG = 1.5
LONGEST: Final = 40  # letters of a label
_LETTER, _KEY = 0.05, 0.3  # inches of a letter and of the mark in a legend


@Drawing
def figure(table: Table, width: float = WIDTH) -> "Figure":
    """Draw a table: a heat map where one field meets one field and neither is the estimator (robot
    x payload), dots with intervals otherwise."""
    fields = (*table.row_fields, *table.column_fields)
    if "estimator" in fields:
        # Trivial predictions would stretch the axis that methods are compared on.
        rows, columns = (
            tuple(key for key in keys if BASELINES.keys().isdisjoint(key))
            for keys in (table.rows, table.columns)
        )
        kept = {k: e for k, e in table.entries.items() if k[0] in rows and k[1] in columns}
        table = replace(table, rows=rows, columns=columns, entries=kept)
    # A map shows levels; estimators are compared with each other, which takes a common axis.
    is_map = len(table.row_fields) == len(table.column_fields) == 1 and "estimator" not in fields
    return _heat_map(table, width) if is_map and len(_panels(table)) == 1 else _dots(table, width)


def _panels(table: Table) -> list[Table]:
    """Noise-free and noisy entries apart, where a table has both, with the columns of each."""
    fields = (*table.row_fields, *table.column_fields)
    if "noise" not in fields:
        return [table]
    place = fields.index("noise")
    exact = {key: e for key, e in table.entries.items() if sum(key, ())[place] == EXACT}
    noisy = {key: e for key, e in table.entries.items() if key not in exact}
    if not (exact and noisy):
        return [table]
    panels = []
    for entries in (exact, noisy):
        columns = tuple(c for c in table.columns if any(key[1] == c for key in entries))
        panels.append(replace(table, columns=columns, entries=entries))
    return panels


def _dots(table: Table, width: float) -> "Figure":
    panels = _panels(table)
    # Height follows the lanes of the fuller panel: both share the rows.
    lanes = max(len(panel.columns) for panel in panels) or 1
    height = max(0.9 + (0.06 + 0.075 * lanes) * len(table.rows), 1.3)
    drawing = new_figure(height, width)
    all_axes = drawing.subplots(1, len(panels), sharey=True, squeeze=False)[0]
    for axes, panel in zip(all_axes, panels, strict=True):
        _one_panel(axes, panel, table.columns)
        if len(panels) > 1:
            axes.set_title("noise-free" if panel is panels[0] else "noisy", fontsize=8)
    all_axes[0].set_yticks(range(len(table.rows)), _labels(table.rows))
    all_axes[0].set_ylim(len(table.rows) - 0.5, -0.5)
    drawing.supxlabel(plain(table.metric.heading), fontsize=8)
    # Names of the columns above the axes, as many beside each other as the width holds.
    pairs = [axes.get_legend_handles_labels() for axes in drawing.axes]
    handles = {name: one for found in pairs for one, name in zip(*found, strict=True)}
    if handles and table.column_fields:
        fitting = int(width / (_LETTER * max(map(len, handles)) + _KEY))
        drawing.legend(handles.values(), handles.keys(), loc="outside upper center",
                       ncols=max(1, min(fitting, len(handles), 4)), frameon=False,
                       handletextpad=0.3, columnspacing=1.0, borderaxespad=0.2)  # fmt: skip
    return drawing


def _one_panel(axes: "Axes", table: Table, columns: Sequence[Key]) -> None:
    """Entries on one axis; a column has the colour of its place among all `columns`."""
    lanes = max(len(table.columns), 1)
    # Logarithmic where no value is negative and they differ by decades.
    values = [entry.value for entry in table.entries.values() if entry.value is not None]
    positive = list(filter(None, values)) or [1.0]
    decades = math.log10(max(positive) / min(positive)) if min(values, default=-1.0) >= 0 else 0.0
    axes.set_xscale("log" if decades > _DECADES_FOR_LOG else "linear")
    for lane, column in enumerate(table.columns):
        # Each lane has its own offset, so that intervals do not overlap.
        offset, place = ((lane + 0.5) / lanes - 0.5) * 0.72, columns.index(column)
        colour, marker = COLOURS[place % len(COLOURS)], _MARKERS[place % len(_MARKERS)]
        points: list[tuple[float, float]] = []
        for i, row in enumerate(table.rows):
            entry = table.entry(row, column)
            if entry is not None:
                points += _one_entry(axes, entry, i + offset, colour)
        name, xy = _label(" · ".join(column)) or None, np.reshape(points, (-1, 2)).T
        axes.plot(*xy, marker, color=colour, markeredgewidth=0, label=name)
    ticks: dict[str, Any] = {"numticks" if axes.get_xscale() == "log" else "nbins": 5}
    axes.locator_params(axis="x", **ticks)
    axes.grid(axis="x", which="major", color="#dddddd", linewidth=0.4)
    axes.set_axisbelow(True)
    # A line between groups of the first row field.
    for last in list(accumulate(map(len, table.rows_by_group)))[:-1]:
        axes.axhline(last - 0.5, color="#bbbbbb", linewidth=0.5)
    axes.spines[["top", "right"]].set_visible(False)
    axes.tick_params(axis="y", length=0)


def _one_entry(axes: "Axes", entry: Entry, y: float, colour: str) -> list[tuple[float, float]]:
    """Draw the interval of a value, or the word instead of it; return the points to mark."""
    lowest = 0.0 if axes.get_xscale() == "log" else -math.inf
    if entry.value is None or entry.value <= lowest:
        # A failure stands as a word at the left edge; a zero on a log axis as 0.
        word = "0" if entry.value is not None else (entry.label or "no value")
        axes.text(0.01, y, plain(word), transform=axes.get_yaxis_transform(), color=colour,
                  fontsize=5.5, fontstyle="italic", va="center")  # fmt: skip
        return []
    if entry.interval:
        low, high = entry.interval
        # An interval that goes beyond a logarithmic axis has no lower end to draw.
        ends = [entry.value if low <= lowest else low, high]
        axes.plot(ends, [y, y], color=colour, solid_capstyle="butt")
    return [(entry.value, y)]


def _heat_map(table: Table, width: float) -> "Figure":
    found = [[(table.entry(r, c) or NO_ENTRY).value for c in table.columns] for r in table.rows]
    with np.errstate(divide="ignore", invalid="ignore"):
        values = np.log10(np.array(found, dtype=float))
    drawing = new_figure(0.7 + 0.24 * len(table.rows), width)
    axes = drawing.add_subplot()
    known = values[np.isfinite(values)]
    low = math.floor(min(known, default=0))
    # Four decades at least: differences within rounding must not look like differences.
    high = max(math.ceil(max(known, default=0)), low + 4)
    axes.set_facecolor("#eeeeee")
    shades = np.ma.masked_invalid(values)
    axes.pcolormesh(shades, cmap="Blues", vmin=low, vmax=high, edgecolors="white", linewidth=1)
    axes.invert_yaxis()
    # White letters on the dark end of the colour map.
    inks = np.where(values > low + 0.6 * (high - low), _ON_DARK, _ON_LIGHT)
    for (i, row), (j, column) in product(enumerate(table.rows), enumerate(table.columns)):
        text = plain(_cell_text(table.entry(row, column) or NO_ENTRY))
        axes.text(j + 0.5, i + 0.5, text, ha="center", va="center", fontsize=6.5,
                  color=str(inks[i, j]))  # fmt: skip
    axes.set_xticks(np.arange(len(table.columns)) + 0.5, _labels(table.columns))
    axes.set_yticks(np.arange(len(table.rows)) + 0.5, _labels(table.rows))
    axes.set_xlabel(plain(table.column_fields[0]))
    axes.set_title(plain(table.metric.heading), fontsize=8)
    axes.tick_params(length=0)
    axes.spines[:].set_visible(False)
    return drawing


def _cell_text(entry: Entry) -> str:
    if entry.value is None:
        return entry.label or ABSENT
    digits = f"{entry.value:.0e}" if entry.value else "0"
    return digits.replace("e-0", "e-").replace("e+0", "e+") + ("*" if entry.note else "")


def _labels(keys: Sequence[Key]) -> list[str]:
    return [_label(" · ".join(key)) for key in keys]


def _label(text: str) -> str:
    """A name, shortened to its two ends where it is long."""
    half = LONGEST // 2
    return plain(text if len(text) <= LONGEST else f"{text[:half]}...{text[-half:]}")
