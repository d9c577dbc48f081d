"""Figures as files of a two-column paper and as elements of a page: size, style, formats."""

import io
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from sysid_bench.errors import UsageError
from sysid_bench.reporting.notation import ABSENT

if TYPE_CHECKING:
    from matplotlib.figure import Figure

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


def svg_of(draw: "Callable[[], Figure]") -> str:
    """A drawing as an <svg> element."""
    return svg_element(_file_bytes(draw, "svg"))


def write_figure(draw: "Callable[[], Figure]", path: Path) -> Path:
    """A drawing as a .pdf, .png or .svg file; raises UsageError for another suffix."""
    kind = path.suffix.lower().removeprefix(".")
    if kind not in METADATA:
        raise UsageError(f"A figure ends with .pdf, .png or .svg; {path.name!r} does not.")
    path.write_bytes(_file_bytes(draw, kind))
    return path


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
    return "".join(c if _has_glyph(c) else "?" for c in text).replace("$", r"\$")


def _has_glyph(c: str) -> bool:
    """True for the letters before Greek, which every font of matplotlib has."""
    return c == ABSENT or (c.isprintable() and ord(c) < 0x370)
