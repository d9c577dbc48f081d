"""Submissions to a results site: folders with the cells and the environment of a run, of which a
share is run again before it is shown."""

import hashlib
import math
import secrets
import shutil
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from sysid_bench.apps.site.suite_version import RepeatShare, Submission
from sysid_bench.commands.result import Result
from sysid_bench.errors import UsageError, first_names, unknown_name
from sysid_bench.harness.comparison.run_difference import find_difference
from sysid_bench.harness.comparison.run_values import read_run
from sysid_bench.harness.plan import cells_of_suite
from sysid_bench.harness.stored_run import RunFolder
from sysid_bench.harness.suite.model import Origin, Suite
from sysid_bench.harness.work.supervise import OnEvent
from sysid_bench.harness.worker_names import worker_names
from sysid_bench.input_files import is_file, parse_toml, read_text
from sysid_bench.metrics import METRICS, names_of
from sysid_bench.verbs.runs.run import run as execute
from sysid_bench.verbs.runs.run_folder import no_rows, open_run
from sysid_bench.words import MACHINE_FIELDS

FACTS: Final = "submission.toml"
SHARE: Final = 0.05
"""Share of the cells that are run again."""
_SCHEMA: Final = 1
_FILES: Final = ("run.toml", "plan.jsonl", "env.json", "cells")
"""What is read of a submission, besides the files that its suite names: tables and data frames are
made from the rows again."""
_OF_MACHINES: Final = ("timeout", "memory", "crash", "lost")
"""Statuses that another machine need not reproduce; rankings count them as failures."""
_SHOWN: Final = 20


@dataclass(frozen=True, eq=False, repr=False)
class CheckResult(Result):
    """Check of a submission: `cells` of the `drawable` ones, drawn with `seed`, were run again;
    `different` are the values that came out otherwise; `planned` the cells whose id or labels are
    not those of the suite; `changed` the rows (file:line) that were changed after they were
    written."""

    folder: str
    seed: int
    drawable: int
    cells: list[str]
    different: list[dict[str, Any]]
    planned: list[str]
    changed: list[str]

    @property
    def ok(self) -> bool:
        """True where nothing differs."""
        return not (self.different or self.planned or self.changed)

    @property
    def share(self) -> RepeatShare:
        """The checked cells, as a site lists them."""
        return RepeatShare(self.seed, self.drawable, tuple(self.cells))

    def summary(self) -> str:
        """Verdict, the ids that differ with their values, and what such a draw can find."""
        lines = [
            f"{self.folder}: {'accepted' if self.ok else 'refused'}; {len(self.cells)} of "
            f"{self.drawable} cells were run again (seed {self.seed})"
        ]
        if self.changed:
            lines.append(f"rows changed after they were written: {first_names(self.changed)}")
        if self.planned:
            lines.append(f"cells that are not those of the suite: {first_names(self.planned)}")
        lines += [_difference(one) for one in self.different[:_SHOWN]]
        if len(self.different) > _SHOWN:
            lines.append(f"{len(self.different) - _SHOWN} more values; --json lists them")
        return "\n".join([*lines, self._power()])

    def _power(self) -> str:
        drawn, of = len(self.cells), self.drawable
        chances = ", ".join(
            f"{find_rate(of, drawn, share):.2f} where {share:.0%} of the cells are"
            for share in (0.01, 0.1, 0.5)
        )
        return f"probability that such a draw finds a false cell: {chances}"

    def _fields(self) -> dict[str, Any]:
        return {"ok": self.ok, **super()._fields()}


def _difference(one: Mapping[str, Any]) -> str:
    return f"{one['id']}  {one['metric']}: submitted {one['submitted']}, computed {one['computed']}"


def find_rate(cells: int, drawn: int, share: float) -> float:
    """Probability that `drawn` of some cells, without replacement, hold one of a `share` that is
    false (at least one cell)."""
    false = min(cells, max(1, round(share * cells)))
    return 1.0 - math.comb(cells - false, drawn) / math.comb(cells, drawn) if cells else 0.0


def random_cells(ids: list[str], share: float, seed: int) -> list[str]:
    """A share of the cells, rounded up, that the seed decides; the same on every machine."""
    order = sorted(ids, key=lambda one: hashlib.sha256(f"{seed} {one}".encode()).digest())
    return order[: math.ceil(share * len(ids))]


def read_submission(folder: Path) -> Submission:
    """The content of submission.toml; empty where there is none. Raises UsageError for unknown keys
    and for values that are not texts."""
    if not is_file(folder / FACTS):
        return Submission()
    try:
        data = parse_toml(read_text(folder / FACTS))
    except (OSError, ValueError) as error:
        raise UsageError(f"{str(folder / FACTS)!r} cannot be read: {error}.") from error
    if data.pop("schema", None) != _SCHEMA:
        raise UsageError(f"{str(folder / FACTS)!r}: give schema = {_SCHEMA}.")
    for key, value in data.items():
        _check_fact(folder / FACTS, key, value)
    return Submission(**data)


def _check_fact(file: Path, key: str, value: Any) -> None:
    known = tuple(Submission.__dataclass_fields__)
    if key not in known:
        raise unknown_name("key of a submission", key, known)
    if not isinstance(value, str):
        raise UsageError(f"{str(file)!r}: {key} is a text; got {value!r}.")


@contextmanager
def without_frames(folder: Path) -> Iterator[RunFolder]:
    """Yield a copy of a submission with its rows, without the data frames made from them; paths in
    its suite are relative to the submission."""
    submitted = open_run(folder)
    with tempfile.TemporaryDirectory(prefix="sysid-bench-") as temporary:
        copy = Path(temporary) / "run"
        copy.mkdir()
        for name in _FILES:
            source = submitted.path / name
            if source.is_dir():
                shutil.copytree(source, copy / name)
            elif is_file(source):
                shutil.copyfile(source, copy / name)
        yield RunFolder(copy)


def check_submission(
    folder: str | Path,
    seed: int | None = None,
    share: float = SHARE,
    jobs: int | None = None,
    on_event: OnEvent | None = None,
) -> CheckResult:
    """Run a random share of the cells of a submission again and compare all their values; its plan
    is made again from its suite. `seed` decides the draw; by default it is drawn, too, so that who
    submits cannot know it.

    Estimators of the submission run as its suite names them: third-party code. Raises UsageError
    for a folder that is not a run, without rows, or whose suite names files that are not there.
    """
    if not 0 < share <= 1:
        raise UsageError(f"The share is {share:g}; give a part of the cells, above 0 and up to 1.")
    chosen = secrets.randbelow(2**32) if seed is None else seed
    with without_frames(Path(folder)) as run:
        rows = run.rows()
        if not rows.rows:
            raise no_rows(open_run(folder))
        suite = _at(run.suite, Path(folder))
        planned = _not_of_the_suite(run, suite)
        ids = _drawable(run, rows.rows)
        drawn = [] if planned else random_cells(ids, share, chosen)
        different = _differences(run, suite, drawn, jobs, on_event) if drawn else []
    return CheckResult(
        folder=str(folder),
        seed=chosen,
        drawable=len(ids),
        cells=drawn,
        different=different,
        planned=planned,
        changed=list(rows.garbled),
    )


def _at(suite: Suite, folder: Path) -> Suite:
    """The suite with its files in the folder of the submission: models in robots/ of it."""
    robots = folder.resolve() / "robots"
    origin = Origin(folder=str(folder.resolve()), robots=str(robots) if robots.is_dir() else None)
    return suite.model_copy(update={"origin": origin})


def _drawable(run: RunFolder, rows: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """Ids of planned cells whose row does not depend on the machine, sorted."""
    planned = run.planned_fields
    return sorted(
        name for name, row in rows.items() if name in planned and row["status"] not in _OF_MACHINES
    )


def _not_of_the_suite(run: RunFolder, suite: Suite) -> list[str]:
    """Ids of planned cells that the suite does not make, or makes with other labels."""
    with worker_names(suite.robots_folder) as names:
        made = cells_of_suite(suite, names, large=True)
    wanted = {cell.id: cell.first_fields for cell in made.cells}
    planned = run.planned_fields
    other = [name for name, head in planned.items() if wanted.get(name) != head]
    return other + [name for name in wanted if name not in planned]


def _compared_metrics() -> tuple[str, ...]:
    """Metrics of cells that are numbers and do not depend on the machine."""
    return tuple(
        name for name in names_of("cell") if name not in MACHINE_FIELDS and not METRICS[name].text
    )


def _differences(
    run: RunFolder,
    suite: Suite,
    cells: list[str],
    jobs: int | None,
    on_event: OnEvent | None,
) -> list[dict[str, Any]]:
    """Values of the cells that differ when they are run again."""
    select = f"id in [{', '.join(map(repr, cells))}]".replace("'", '"')
    metrics = _compared_metrics()
    with tempfile.TemporaryDirectory(prefix="sysid-bench-") as folder:
        again = execute(
            suite, Path(folder) / "again", jobs=jobs, select=select, on_event=on_event,
            robots_dir=suite.robots_folder, large=True,
        )  # fmt: skip
        computed = read_run(again.folder, metrics)
    submitted = read_run(run, metrics)
    changes = find_difference(computed, submitted, partial=True)
    return [
        {"id": one.cell, "metric": one.metric, "submitted": one.after, "computed": one.before}
        for one in changes.cells
        if one.cell in cells
    ]
