"""The command `figure`: figures of a report as files for a paper."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Final

from sysid_bench.commands.result import Result
from sysid_bench.errors import unknown_name
from sysid_bench.reporting import ranking_figures as profile_figure
from sysid_bench.reporting.error_figures import size_errors, size_figure
from sysid_bench.reporting.figures import DOUBLE, WIDTH
from sysid_bench.reporting.figures import figure as draw_table
from sysid_bench.reporting.ranking import Ranking
from sysid_bench.reporting.ranking_figures import cost_by_method, cost_figure
from sysid_bench.reporting.signal_figures import StoredCurves, StoredTorque
from sysid_bench.verbs.runs.paper_output import paper_figures, write_paper_figure
from sysid_bench.verbs.runs.report import result_of, table_of
from sysid_bench.verbs.runs.run_folder import open_run

if TYPE_CHECKING:
    from sysid_bench.harness.frames import Frames

SIZES: Final[Mapping[str, float]] = {"single": WIDTH, "double": DOUBLE}
"""Inches of one and of both columns of a two-column paper."""

ALL: Final = "all"
TRAINING_SIZES: Final = "training-size"
RECORDED: Final = "recorded"
"""Label of the simulation of recorded robots."""

_SUFFIXES: Final = ("pdf", "png")
_Draw = Callable[[Path, float], Path]


@dataclass(frozen=True, eq=False, repr=False)
class FigureResult(Result):
    """Names of the figures of a run, and the files that were written."""

    names: list[str]
    files: list[str]

    def summary(self) -> str:
        """The files, or the names where none was asked for; a line each."""
        return "\n".join(self.files or self.names)


def figure(
    folder: str | Path, name: str | None = None, size: str = "single", out: str | Path | None = None
) -> FigureResult:
    """Write one figure of a run, or "all", as NAME.pdf and NAME.png into `out` (default: the run's
    figures/); without a name, list the names. NAME-double is that of both columns.

    Raises UsageError for an unknown name or size, and for a folder without rows.
    """
    if size not in SIZES:
        raise unknown_name("size", size, SIZES)
    drawings = _drawing(folder, name) or _drawings(folder)
    target = Path(folder) / "figures" if out is None else Path(out)
    files = _write(_chosen(drawings, name), target, size)
    return FigureResult(names=list(drawings), files=files)


def _chosen(drawings: Mapping[str, _Draw], name: str | None) -> Mapping[str, _Draw]:
    if name is None:
        return {}
    if name == ALL:
        return drawings
    if name not in drawings:
        raise unknown_name("figure", name, [*drawings, ALL])
    return {name: drawings[name]}


def _write(chosen: Mapping[str, _Draw], target: Path, size: str) -> list[str]:
    """Paths of the pictures, whose folder is made where there is one to write."""
    if not chosen:
        return []
    target.mkdir(parents=True, exist_ok=True)
    suffix = "" if size == "single" else f"-{size}"
    return [
        str(draw(target / f"{name}{suffix}.{kind}", SIZES[size]))
        for name, draw in chosen.items()
        for kind in _SUFFIXES
    ]


def _drawing(folder: str | Path, name: str | None) -> dict[str, _Draw]:
    """The figure of one table, or of training lengths, without making all others; empty for other
    names."""
    if name == TRAINING_SIZES:
        return _training_sizes(open_run(folder).frames())
    made = None if name in (None, ALL) else table_of(folder, str(name))
    return {made.name: partial(draw_table, made)} if made is not None and made.has_figure else {}


def _drawings(folder: str | Path) -> dict[str, _Draw]:
    """Functions that draw the figures of a run, by name."""
    run, frames, made_tables, ranked = result_of(folder)
    tables: dict[str, _Draw] = {made.name: partial(draw_table, made) for made in made_tables}
    rankings = {one.name: partial(profile_figure.profile, one) for one in ranked}
    papers = {name: partial(_draw_paper, sample) for name, sample in paper_figures(run)}
    return {**tables, **rankings, **_costs(frames, ranked), **papers, **_training_sizes(frames)}


def _costs(frames: "Frames", ranked: Iterable[Ranking]) -> dict[str, _Draw]:
    cells = frames.cells
    return {
        f"{one.name}-cost": partial(cost_figure, one, cells)
        for one in ranked
        if cost_by_method(one, cells)
    }


def _training_sizes(frames: "Frames") -> dict[str, _Draw]:
    """The figure of errors by training length, where a run has several lengths."""
    cells = frames.cells
    if not {"simulation", "log.seconds"} <= set(cells.columns):
        return {}
    recorded = cells[(cells["simulation"] == RECORDED) & (cells["status"] == "ok")]
    recorded = recorded[recorded["task"] == "robot"]
    lengths = recorded.groupby(["robot", "pipeline"])["log.seconds"].nunique()
    if lengths.empty or lengths.max() < 2:
        return {}
    sizes = size_errors(recorded, frames.joints)
    return {TRAINING_SIZES: lambda path, width: size_figure(path, sizes, max(width, DOUBLE))}


def _draw_paper(sample: StoredTorque | StoredCurves, path: Path, width: float) -> Path:
    return write_paper_figure(path, sample, width)
