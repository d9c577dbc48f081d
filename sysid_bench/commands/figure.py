"""Verb `figure`: figures of a report as files for a paper."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from sysid_bench.commands.request import Request, argument, option, python_function
from sysid_bench.commands.result import Result
from sysid_bench.errors import unknown_name
from sysid_bench.words import RECORDED

if TYPE_CHECKING:
    from sysid_bench.harness.frames import Frames
    from sysid_bench.reporting.figures import Drawing

SIZES: Final = ("single", "double")
"""Columns of a two-column paper that a figure takes."""
ALL: Final = "all"
TRAINING_SIZES: Final = "training-size"
_SUFFIXES: Final = ("pdf", "png")
_Draw = Callable[[Path, float], Path]


class Figure(Request["FigureResult"]):
    """Write a figure of a run, or "all", as PDF and PNG; without a name, list them."""

    folder: str | Path = argument("RUN", complete="runs folders")
    name: str | None = argument("[NAME]", default=None)
    size: str = option("Columns of the page.", default="single", choices=SIZES, shown=True)
    out: str | Path | None = option(
        "Folder; default: figures/ of the run.",
        default=None, flags="-o --out", path="new", complete="folders",
    )  # fmt: skip

    def run(self) -> "FigureResult":
        """Write one figure of a run, or "all", as NAME.pdf and NAME.png into `out` (default: the
        run's figures/); without a name, list the names. NAME-double is that of both columns.

        Raises UsageError for an unknown name or size, and for a folder without rows.
        """
        from sysid_bench.reporting.figures import DOUBLE, WIDTH

        if self.size not in SIZES:
            raise unknown_name("size", self.size, SIZES)
        drawings = _drawing(self.folder, self.name) or _drawings(self.folder)
        chosen = drawings if self.name == ALL else {}
        if self.name not in (None, ALL):
            if self.name not in drawings:
                raise unknown_name("figure", str(self.name), [*drawings, ALL])
            chosen = {str(self.name): drawings[str(self.name)]}
        target = Path(self.folder) / "figures" if self.out is None else Path(self.out)
        if chosen:
            target.mkdir(parents=True, exist_ok=True)
        suffix, width = ("", WIDTH) if self.size == "single" else (f"-{self.size}", DOUBLE)
        files = [
            str(draw(target / f"{name}{suffix}.{kind}", width))
            for name, draw in chosen.items()
            for kind in _SUFFIXES
        ]
        return FigureResult(names=list(drawings), files=files)


figure = python_function(Figure, "figure")


@dataclass(frozen=True, eq=False, repr=False)
class FigureResult(Result):
    """Names of the figures of a run, and the files that were written."""

    names: list[str]
    files: list[str]

    def summary(self) -> str:
        """The files, or the names where none was asked for; a line each."""
        return "\n".join(self.files or self.names)


def _drawing(folder: str | Path, name: str | None) -> dict[str, _Draw]:
    """The figure of one table, or of training lengths, without making all others; empty for other
    names."""
    from sysid_bench.commands.run_folder import open_run
    from sysid_bench.commands.run_report import table_of
    from sysid_bench.reporting import figures

    # All other figures would be made first: rankings resample thousands of times.
    if name == TRAINING_SIZES:
        return _training_sizes(open_run(folder).frames())
    made = None if name in (None, ALL) else table_of(folder, str(name))
    return {made.name: _into(figures.figure, made)} if made is not None and made.has_figure else {}


def _into(drawing: "Drawing[...]", *data: Any) -> _Draw:
    return lambda path, width: drawing.write(path, *data, width)


def _drawings(folder: str | Path) -> dict[str, _Draw]:
    """Functions that draw the figures of a run, by name."""
    from sysid_bench.commands.paper import paper_figures, write_paper_figure
    from sysid_bench.commands.run_report import result_of
    from sysid_bench.reporting import figures
    from sysid_bench.reporting.ranking_figures import cost_by_method, cost_figure, profile

    run, frames, tables, ranked = result_of(folder)
    cells = frames.cells
    found: dict[str, _Draw] = {made.name: _into(figures.figure, made) for made in tables}
    found |= {one.name: _into(profile, one) for one in ranked}
    costs = (one for one in ranked if cost_by_method(one, cells))
    found |= {f"{one.name}-cost": _into(cost_figure, one, cells) for one in costs}
    found |= {name: partial(write_paper_figure, sample) for name, sample in paper_figures(run)}
    return {**found, **_training_sizes(frames)}


def _training_sizes(frames: "Frames") -> dict[str, _Draw]:
    """The figure of errors by training length, where a run has several lengths."""
    from sysid_bench.reporting.error_figures import size_errors, size_figure
    from sysid_bench.reporting.figures import DOUBLE

    cells = frames.cells
    if not {"simulation", "log.seconds"} <= set(cells.columns):
        return {}
    recorded = cells[(cells["simulation"] == RECORDED) & (cells["status"] == "ok")]
    recorded = recorded[recorded["task"] == "robot"]
    lengths = recorded.groupby(["robot", "pipeline"])["log.seconds"].nunique()
    if lengths.empty or lengths.max() < 2:
        return {}
    sizes = size_errors(recorded, frames.joints)
    return {TRAINING_SIZES: lambda path, width: size_figure.write(path, sizes, max(width, DOUBLE))}
