"""Baselines of runs as files: written, taken over, read."""

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from sysid_bench.commands.result import Result
from sysid_bench.errors import UsageError
from sysid_bench.harness.comparison.baseline import (
    Baseline,
    baseline_of,
    from_text,
    to_text,
    update_of,
)
from sysid_bench.harness.comparison.run_difference import find_difference
from sysid_bench.harness.comparison.run_values import Tolerance, read_run, tolerance_of
from sysid_bench.harness.stored_run import RunFolder
from sysid_bench.input_files import read_text
from sysid_bench.metrics import METRICS
from sysid_bench.verbs.runs.change_table import first_names
from sysid_bench.verbs.runs.run_folder import open_run

_NO_TIMES: Final = "no part with three CPU times or more of one cell"


@dataclass(frozen=True, eq=False, repr=False)
class BaselineResult(Result):
    """A baseline that was written: its file, cells and metrics, and the `taken` changes from the
    one that was there. `untimed` robots and parts had times there and have none in the run; `kept`:
    no part has, and those of before stay."""

    file: str
    cells: int
    metrics: list[str]
    bytes: int
    taken: int | None
    untimed: list[str]
    kept: bool

    def summary(self) -> str:
        """One sentence."""
        taken = "" if self.taken is None else f"; {self.taken} changes taken over"
        times = f"; {self._times}" if self.untimed else ""
        return f"{self.file}: {self.cells} cells, {self.bytes} bytes{taken}{times}"

    @property
    def _times(self) -> str:
        if self.kept:
            return f"times are those of before, since the run has {_NO_TIMES}"
        return f"without times that were there: {first_names(self.untimed)}"


def read_baseline(file: str | Path) -> Baseline:
    """The baseline of a file; raises UsageError where it is not one."""
    try:
        return from_text(read_text(Path(file)), str(file))
    except (OSError, UnicodeDecodeError) as error:
        why = "it is not a text" if isinstance(error, UnicodeDecodeError) else error.strerror
        raise UsageError(
            f"The baseline {str(file)!r} cannot be read ({why or error}); write one with "
            "'sysid-bench baseline save RUN -o FILE'."
        ) from error


def baseline_save(
    run: str | Path,
    out: str | Path,
    *,
    metrics: Sequence[str] = (),
    tolerances: Mapping[str, float] | None = None,
    times: bool = False,
) -> BaselineResult:
    """Write the baseline of a run.

    `metrics` replace the default ones; `tolerances`: metric -> size, in the kind of its default
    (a factor for errors, a difference for gaps); `times`: ratios of times within the run, too.
    Raises UsageError for an unknown metric, and where the `times` asked for are not there.
    """
    sizes = _tolerances(tolerances or {})
    folder = open_run(run)
    values = read_run(folder, tuple(metrics), times=times)
    if times and not values.speeds:
        raise without_times(folder)
    return _write(baseline_of(values, sizes), Path(out))


def without_times(run: RunFolder) -> UsageError:
    """The error of a run that has no times to compare."""
    return UsageError(
        f"{str(run.path)!r} has {_NO_TIMES}; --times needs a suite with 'repeats = 3' or more, "
        "and ok cells."
    )


def _tolerances(sizes: Mapping[str, float]) -> dict[str, Tolerance]:
    found = {}
    for name, size in sizes.items():
        known = tolerance_of(METRICS[name]) if name in METRICS else Tolerance("ratio", 1.01, 0.0)
        kind = "ratio" if known.kind == "exact" else known.kind
        try:
            found[name] = Tolerance(kind, size, known.floor)
        except UsageError as error:
            raise UsageError(f"The tolerance {name}={size:g} cannot be: {error}") from error
    return found


def _write(
    baseline: Baseline,
    file: Path,
    taken: int | None = None,
    untimed: Sequence[str] = (),
    *,
    kept: bool = False,
) -> BaselineResult:
    text = to_text(baseline)
    file.parent.mkdir(parents=True, exist_ok=True)
    # All or nothing: a full disk must not cost the baseline that was there.
    part = file.with_name(f".{file.name}.{os.getpid()}")
    part.write_text(text, encoding="utf-8")
    part.replace(file)
    run = baseline.run
    return BaselineResult(
        file=str(file),
        cells=len(run.cells),
        metrics=[*run.metrics],
        bytes=len(text.encode()),
        taken=taken,
        untimed=[*untimed],
        kept=kept,
    )


def baseline_update(run: str | Path, file: str | Path) -> BaselineResult:
    """Take the changes of a run over into a baseline: what a comparison with it finds, and nothing
    else, so that values within their tolerance stay. Metrics and tolerances stay, and times where
    the run has none."""
    old = read_baseline(file)
    now = read_run(open_run(run), tuple(old.run.metrics), times=bool(old.run.speeds))
    changes = find_difference(old.run, now, old.tolerances)
    kept = bool(old.run.speeds) and not now.speeds
    update = update_of(changes)
    return _write(
        baseline_of(update.run, old.tolerances),
        Path(file),
        update.taken,
        changes.without_time,
        kept=kept,
    )
