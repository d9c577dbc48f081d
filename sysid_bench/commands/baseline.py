"""Verbs `baseline save` and `baseline update`: a small file of the values of a run."""

from collections.abc import Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from sysid_bench.commands.compare import metrics_option
from sysid_bench.commands.request import Request, argument, option, python_function
from sysid_bench.commands.result import Result
from sysid_bench.commands.values import parse_numbers
from sysid_bench.errors import UsageError

if TYPE_CHECKING:
    from sysid_bench.harness.comparison.baseline import Baseline
    from sysid_bench.harness.comparison.run_values import RunValues
    from sysid_bench.harness.stored_run import RunFolder

_NO_TIMES: Final = "no part with three CPU times or more of one cell"


def times_option() -> Any:
    return option(
        "Times, too, as ratios within the run (three repeats or more).", default=False,
        flags="--times",
    )  # fmt: skip


class BaselineSave(Request["BaselineResult"]):
    """Save the baseline of a run: sorted, a line per cell, with versions and tolerances."""

    folder: str | Path = argument("RUN", complete="runs folders")
    out: str | Path = option(
        "JSON file to write.", flags="-o --out", path="new file", complete="files"
    )
    _: KW_ONLY
    metrics: Sequence[str] = metrics_option()
    tolerances: Mapping[str, float] | None = option(
        "Factor for an error, difference for a gap; in place of the default.",
        default=None, flags="--tolerance", metavar="METRIC=SIZE", several=True,
        parse=lambda texts: parse_numbers("tolerance", texts), complete="metrics",
    )  # fmt: skip
    times: bool = times_option()

    def run(self) -> "BaselineResult":
        """Write the baseline of a run.

        `metrics` replace the default ones; `tolerances`: metric -> size, in the kind of its default
        (a factor for errors, a difference for gaps); `times`: ratios of times within the run, too.
        Raises UsageError for an unknown metric, and where the `times` asked for are not there.
        """
        from sysid_bench.harness.comparison.baseline import baseline_of
        from sysid_bench.harness.comparison.run_values import Tolerance, read_run

        folder, sizes = _whole_run(self.folder), {}
        values = read_run(folder, tuple(self.metrics), times=self.times)
        if self.times and not values.speeds:
            raise without_times(folder)
        default = baseline_of(values).tolerances
        for name, size in (self.tolerances or {}).items():
            known = default.get(name, Tolerance("exact"))
            kind = "ratio" if known.kind == "exact" else known.kind
            try:
                sizes[name] = Tolerance(kind, size, known.floor)
            except UsageError as error:
                raise UsageError(f"The tolerance {name}={size:g} cannot be: {error}") from error
        return _write(baseline_of(values, sizes), Path(self.out))


class BaselineUpdate(Request["BaselineResult"]):
    """Take the changes of a run over into its baseline; values within their tolerance stay, and so
    do tolerances and metrics."""

    folder: str | Path = argument("RUN", complete="runs folders")
    out: str | Path = option(
        "Baseline to replace.", flags="-o --out", path="new file", complete="files"
    )

    def run(self) -> "BaselineResult":
        """Take the changes of a run over into a baseline: what a comparison with it finds, and
        nothing else, so that values within their tolerance stay unless they drift in common.
        Metrics and tolerances stay, and times where the run has none."""
        from sysid_bench.harness.comparison.baseline import baseline_of, update_of
        from sysid_bench.harness.comparison.run_difference import find_difference
        from sysid_bench.harness.comparison.run_values import read_run

        old = read_baseline(self.out)
        run, metrics = _whole_run(self.folder), tuple(old.run.metrics)
        now = read_run(run, metrics, times=bool(old.run.speeds))
        changes = find_difference(old.run, now, old.tolerances)
        update = update_of(changes)
        # With the old tolerances: those of a baseline are part of an agreement, not of a run.
        written = _write(baseline_of(update.run, old.tolerances, old.digits), Path(self.out))
        return replace(
            written,
            taken=update.taken,
            counts=dict(update.counts),
            untimed=[*changes.without_time],
            kept=bool(old.run.speeds) and not now.speeds,
        )


baseline_save = python_function(BaselineSave, "baseline_save")
baseline_update = python_function(BaselineUpdate, "baseline_update")


@dataclass(frozen=True, eq=False, repr=False)
class BaselineResult(Result):
    """A baseline that was written: its file, cells and metrics, and the `taken` changes from the
    one that was there, with their `counts` by kind. `untimed` robots and parts had times there and
    have none in the run; `kept`: no part has, and those of before stay."""

    file: str
    cells: int
    metrics: list[str]
    bytes: int
    taken: int | None = None
    counts: dict[str, int] = field(default_factory=dict)
    untimed: list[str] = field(default_factory=list)
    kept: bool = False

    def summary(self) -> str:
        """One sentence."""
        from sysid_bench.commands.changes import first_labels

        kinds = ", ".join(f"{count} {what}" for what, count in self.counts.items())
        taken = "" if self.taken is None else f"; {self.taken} changes taken over"
        taken += f" ({kinds})" if kinds else ""
        times = ""
        if self.untimed and self.kept:
            times = f"; times are those of before, since the run has {_NO_TIMES}"
        elif self.untimed:
            times = f"; without times that were there: {first_labels(self.untimed)}"
        return f"{self.file}: {self.cells} cells, {self.bytes} bytes{taken}{times}"


def _whole_run(folder: str | Path) -> "RunFolder":
    """Open a run; raise UsageError for one with damaged rows, whose cells would become open ones of
    a baseline, which no gate compares."""
    from sysid_bench.commands.run_folder import damage_note, open_run

    run = open_run(folder)
    if run.damaged:
        raise UsageError(f"{str(folder)!r}: {damage_note(run.damaged)}")
    return run


def read_baseline(file: str | Path) -> "Baseline":
    """Return the baseline of a file; raise UsageError where it is not one."""
    from sysid_bench.harness.comparison.baseline import from_text
    from sysid_bench.input_files import read_text

    try:
        return from_text(read_text(Path(file)), str(file))
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or error
        raise UsageError(
            f"The baseline {str(file)!r} cannot be read ({reason}); write one with "
            "'sysid-bench baseline save RUN -o FILE'."
        ) from error


def known_baseline(file: str | Path, *, times: bool) -> "Baseline":
    """Return the baseline of a file; raise UsageError for one without the `times` asked for."""
    known = read_baseline(file)
    if times and not known.run.speeds:
        raise UsageError(
            f"The baseline {str(file)!r} holds no times; save it with 'sysid-bench baseline save "
            f"RUN -o {file} --times', from three repeats or more."
        )
    return known


def _write(baseline: "Baseline", file: Path) -> BaselineResult:
    from sysid_bench.commands.run_folder import write_whole
    from sysid_bench.harness.comparison.baseline import to_text

    text = to_text(baseline)
    write_whole(file, text)
    cells, metrics = len(baseline.run.cells), [*baseline.run.metrics]
    return BaselineResult(str(file), cells, metrics, len(text.encode()))


def without_times(run: "RunFolder") -> UsageError:
    """The error of a run that has no times to compare."""
    return UsageError(
        f"{str(run.path)!r} has {_NO_TIMES}; --times needs a suite with 'repeats = 3' or more, "
        "and ok cells."
    )


def values_of_run(run: "RunFolder", metrics: Sequence[str], *, times: bool = False) -> "RunValues":
    """Return what a run is compared by; raise UsageError for one without rows."""
    from sysid_bench.commands.run_folder import no_rows
    from sysid_bench.harness.comparison.run_values import read_run

    values = read_run(run, metrics, times=times)
    if all(cell.status == "open" for cell in values.cells.values()):
        raise no_rows(run)
    return values
