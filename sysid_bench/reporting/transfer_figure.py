"""False claims and real differences found, by source of the simulation, with their intervals."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from sysid_bench.reporting.figure_files import COLOURS, WIDTH, new_figure, plain, write_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Figures = Mapping[str, Mapping[str, Any]]
"""By source the figures of TransferResult."""

_PANELS: Final = (
    ("false", "false claims [%]", 20.0),
    ("found", "real differences found [%]", 50.0),
)
"""Figure, label, and the aim (%)."""


def transfer_figure(path: Path, figures: Figures, width: float = WIDTH) -> Path:
    """Draw the shares of each source into a .pdf, .png or .svg file, the same bytes every time;
    the dashed line is the aim. Raises UsageError for another suffix."""
    return write_figure(lambda: _picture(figures, width), path)


def _picture(figures: Figures, width: float) -> "Figure":
    sources = list(figures)
    picture = new_figure(0.6 + 0.14 * len(sources), width)
    panels = picture.subplots(1, 2, sharey=True)
    for axes, (word, label, aim) in zip(panels, _PANELS, strict=True):
        _shares(axes, [figures[source][word] for source in sources])
        axes.axvline(aim, color=COLOURS[6], linewidth=0.5, linestyle="--")
        axes.set_xlabel(label)
        axes.set_xlim(-4, 104)
        axes.spines[["top", "right"]].set_visible(False)
    panels[0].set_yticks(range(len(sources)), [plain(source) for source in sources])
    panels[0].invert_yaxis()
    return picture


def _shares(axes: "Axes", shares: Sequence[Mapping[str, Any]]) -> None:
    for k, share in enumerate(shares):
        if share["value"] is None:
            continue
        axes.plot(100 * share["value"], k, "o", color=COLOURS[0])
        if share["low"] is not None:
            axes.plot([100 * share["low"], 100 * share["high"]], [k, k], color=COLOURS[0])
