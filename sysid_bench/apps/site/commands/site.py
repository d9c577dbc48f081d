"""Verb `site`: runs and checked submissions as a static site of results.

A submission is a folder with the cells and the environment of a run. A random share of its cells is
run again before it is shown.
"""

import hashlib
import math
import secrets
import shutil
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import click

from sysid_bench.commands.request import (
    FAILED,
    OK,
    Request,
    argument,
    option,
    python_function,
)
from sysid_bench.commands.result import Result
from sysid_bench.errors import UsageError, first_names, unknown_name
from sysid_bench.input_files import is_file, parse_toml, read_text

if TYPE_CHECKING:
    from sysid_bench.apps.site.suite_version import RepeatShare, SiteRun, Submission
    from sysid_bench.harness.stored_run import RunFolder
    from sysid_bench.harness.suite.model import Suite

OnEvent = Callable[[str, Mapping[str, Any]], None]
"""Called with the kind and the data of each event of a run."""
FACTS: Final = "submission.toml"
SHARE: Final = 0.05
"""Share of the cells that are run again."""
_SCHEMA: Final = 1
_OWN: Final = ("suites", "robots", "methods")
"""Folders of a site, which are made anew."""
_FILES: Final = ("run.toml", "plan.jsonl", "models.json", "env.json", "cells")
"""Files read of a submission, besides the files that its suite names: tables and data frames are
made from the rows again."""
_OF_MACHINES: Final = ("timeout", "memory", "crash", "lost")
"""Statuses that another machine need not reproduce; rankings count them as failures."""
_SHOWN: Final = 20


class Site(Request["SiteResult"]):
    """Write a static site of runs: suites, robots, methods, leaderboard.json.

    Exit code 1 where a submission is refused: nothing is written then.
    """

    runs: Sequence[str | Path] = argument(
        "[RUN...]", default=(), several=True, complete="runs folders"
    )
    out: str | Path | None = option(
        "Folder of the site.",
        default=None, flags="-o --out", path="new folder", complete="folders",
    )  # fmt: skip
    submissions: Sequence[str | Path] = option(
        "A submission: a share of its cells runs again; with -o it joins the site.",
        default=(), flags="--check", metavar="FOLDER", several=True, complete="runs folders",
    )  # fmt: skip
    seed: int | None = option("Seed of that draw; default: a new one.", default=None, least=0)
    share: float = option("Cells that run again.", default=SHARE, unit="1", shown="5 %")
    jobs: int | None = option(
        "Workers; default one per core.", default=None, flags="-j --jobs", least=1
    )
    on_event: OnEvent | None = field(default=None, kw_only=True)

    def run(self) -> "SiteResult":
        """Write the site of some runs, and of `submissions` whose check finds no difference, into
        the folder `out`; without it, only check the submissions.

        `seed` and `share` (0 to 1) decide which cells of each submission run again. A site that is
        there is replaced. Raises UsageError for a folder that is not a run or without rows, and for
        an `out` with other files.
        """
        from sysid_bench.apps.site.site_pages import LEADERBOARD, site_pages
        from sysid_bench.commands.run_folder import open_run, row_notes, write_whole

        out = None if self.out is None else Path(self.out)
        self._check(out)
        read = []
        for folder in self.runs:
            run = open_run(folder)
            shown = _site_run(run, Path(folder).resolve().name)
            notes = tuple(filter(None, [row_notes(run)]))
            read.append(replace(shown, notes=notes, submission=read_submission(Path(folder))))
        checks = tuple(
            check_submission(one, self.seed, self.share, self.jobs, self.on_event)
            for one in self.submissions
        )
        if out is None or not all(check.ok for check in checks):
            return SiteResult(None, [], checks)
        pages = site_pages([*read, *map(_submitted_run, checks)])
        for name in _OWN:
            # Pages of runs that are gone must not stay; other files in the folder are not ours.
            shutil.rmtree(out / name, ignore_errors=True)
        # leaderboard.json last: what reads it finds the pages that it names.
        for path in sorted(pages, key=lambda name: name == LEADERBOARD):
            write_whole(out / path, pages[path])
        return SiteResult(str(out), sorted(pages), checks)

    def _check(self, out: Path | None) -> None:
        """Raise UsageError, before anything runs, for a request that gives no site."""
        from sysid_bench.apps.site.site_pages import LEADERBOARD

        if not self.runs and not self.submissions:
            raise UsageError(
                "A site needs runs: 'sysid-bench site RUN... -o site', or --check FOLDER."
            )
        if self.runs and out is None:
            raise UsageError("A site of runs needs a folder: -o site.")
        if out is None or not out.exists() or is_file(out / LEADERBOARD):
            return
        if not out.is_dir() or any(out.iterdir()):
            raise UsageError(
                f"{str(out)!r} is there and not a site: it has no {LEADERBOARD}. Choose another -o."
            )

    def shell(self, as_json: bool) -> int:
        if self.on_event is None:
            return replace(self, on_event=_print_code).shell(as_json)
        return super().shell(as_json)

    def exit_code(self, result: "SiteResult") -> int:
        return OK if result.ok else FAILED


site = python_function(Site, "site")


def _print_code(kind: str, data: Mapping[str, Any]) -> None:
    """Name the third-party code of a submission before it runs."""
    if kind == "code":
        click.echo(data["note"], err=True)


@dataclass(frozen=True, eq=False, repr=False)
class SiteResult(Result):
    """A site in `folder` (None where nothing is written): its files, and the checks of
    submissions."""

    folder: str | None
    files: list[str]
    checks: "tuple[CheckResult, ...]"

    @property
    def ok(self) -> bool:
        """True where every submission is accepted."""
        return all(check.ok for check in self.checks)

    def summary(self) -> str:
        """The checks, and where the site is."""
        lines = [check.summary() for check in self.checks]
        if self.folder is not None:
            lines.append(f"{len(self.files)} files: {Path(self.folder) / 'index.html'}")
        elif not self.ok:
            lines.append("no site is written while a submission is refused")
        return "\n".join(lines)

    def _fields(self) -> dict[str, Any]:
        return super()._fields() | {"checks": [check.to_dict() for check in self.checks]}


@dataclass(frozen=True, eq=False, repr=False)
class CheckResult(Result):
    """Check of a submission: `cells` of the `drawable` ones, drawn with `seed`, were run again;
    `different` are the values that came out otherwise; `planned` the cells whose id or labels are
    not those of the suite; `changed` the rows (file:line) that were changed after they were
    written, and env.json where its digest is of other rows; `refused` the cells by any other
    reason, for which none is run; `digest`: the SHA-256 of all rows."""

    folder: str
    seed: int
    drawable: int
    cells: list[str]
    different: list[dict[str, Any]]
    planned: list[str]
    changed: list[str]
    refused: dict[str, list[str]]
    digest: str

    @property
    def ok(self) -> bool:
        """True where nothing differs."""
        return not (self.different or self.planned or self.changed or self.refused)

    @property
    def share(self) -> "RepeatShare":
        """The checked cells, as a site lists them."""
        from sysid_bench.apps.site.suite_version import RepeatShare

        return RepeatShare(self.seed, self.drawable, tuple(self.cells))

    def summary(self) -> str:
        """Verdict, the ids that differ with their values, and what such a draw can find."""
        drawn, of = len(self.cells), self.drawable
        lines = [
            f"{self.folder}: {'accepted' if self.ok else 'refused'}; {drawn} of "
            f"{of} cells were run again (seed {self.seed})",
            f"digest of its rows: {self.digest}",
        ]
        if self.changed:
            lines.append(f"rows changed after they were written: {first_names(self.changed)}")
        if self.planned:
            lines.append(f"cells that are not those of the suite: {first_names(self.planned)}")
        lines += (f"{why}: {first_names(cells)}" for why, cells in self.refused.items())
        lines += (
            f"{one['id']}  {one['metric']}: submitted {one['submitted']}, computed "
            f"{one['computed']}"
            for one in self.different[:_SHOWN]
        )
        if len(self.different) > _SHOWN:
            lines.append(f"{len(self.different) - _SHOWN} more values; --json lists them")
        chances = ", ".join(
            f"{find_rate(of, drawn, share):.2f} where {share:.0%} of the cells are"
            for share in (0.01, 0.1, 0.5)
        )
        lines.append(f"probability that such a draw finds a false cell: {chances}")
        return "\n".join(lines)

    def _fields(self) -> dict[str, Any]:
        return {"ok": self.ok, **super()._fields()}


def _submitted_run(check: CheckResult) -> "SiteRun":
    from sysid_bench.apps.site.suite_version import Submission

    folder = Path(check.folder)
    with without_frames(folder) as rows:
        facts = read_submission(folder) or Submission()
        shown = _site_run(rows, folder.resolve().name)
        return replace(shown, submission=facts, checked=check.share)


def _site_run(run: "RunFolder", name: str) -> "SiteRun":
    """Rows and origin of a run."""
    from sysid_bench.apps.site.suite_version import SiteRun
    from sysid_bench.canonical_json import canonical
    from sysid_bench.commands.run_folder import no_rows, row_selection

    cells = run.frames().cells
    if len(cells) == 0:
        raise no_rows(run)
    plan = run.plan.cells
    sealed = {c.labels["plant"] for c in plan if c.spec.plant.get("sealed")}
    return SiteRun(
        name=name,
        suite=parse_toml(read_text(run.path / "run.toml")),
        env=run.environment,
        cells=cells,
        planned=len(plan),
        choose=row_selection(run),
        methods={c.labels["estimator"]: canonical(c.estimator) for c in plan},
        metrics=run.suite.metrics,
        sealed=tuple(sorted(sealed)),
        models={robot: str(record["hash"]) for robot, record in run.models.items()},
    )


# --- Submissions --------------------------------------------------------------------------------


def find_rate(cells: int, drawn: int, share: float) -> float:
    """Return the probability that `drawn` of some cells, without replacement, hold one of a `share`
    that is false (at least one cell)."""
    # Hypergeometric: 1 - C(n - k, m) / C(n, m).
    false = min(cells, max(1, round(share * cells)))
    return 1.0 - math.comb(cells - false, drawn) / math.comb(cells, drawn) if cells else 0.0


def random_cells(ids: list[str], share: float, seed: int) -> list[str]:
    """Return a share of the cells, rounded up, that the seed decides; the same on every machine."""
    # By hash and not by a generator, whose stream may change between versions of Python.
    order = sorted(ids, key=lambda one: hashlib.sha256(f"{seed} {one}".encode()).digest())
    return order[: math.ceil(share * len(ids))]


def read_submission(folder: Path) -> "Submission | None":
    """Return the content of submission.toml; None where there is none. Raises UsageError for
    unknown keys and for values that are not texts."""
    from sysid_bench.apps.site.suite_version import Submission

    file = folder / FACTS
    if not is_file(file):
        return None
    try:
        data = parse_toml(read_text(file))
    except (OSError, ValueError) as error:
        raise UsageError(f"{str(file)!r} cannot be read: {error}.") from error
    if data.pop("schema", None) != _SCHEMA:
        raise UsageError(f"{str(file)!r}: give schema = {_SCHEMA}.")
    known = tuple(Submission.__dataclass_fields__)
    for key, value in data.items():
        if key not in known:
            raise UsageError(f"{str(file)!r}: {unknown_name('key of a submission', key, known)}")
        if not isinstance(value, str):
            raise UsageError(f"{str(file)!r}: {key} is a text; got {value!r}.")
    if (url := data.get("url", "")) and not url.startswith("https://"):
        raise UsageError(f"{str(file)!r}: url is the address of a page, https://...; got {url!r}.")
    return Submission(**data)


@contextmanager
def without_frames(folder: Path) -> "Iterator[RunFolder]":
    """Yield a copy of a submission with its rows, without the data frames made from them; paths in
    its suite are relative to the submission."""
    from sysid_bench.commands.run_folder import open_run
    from sysid_bench.harness.stored_run import RunFolder

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
        # Rows alone: data frames of a submission could say what its rows do not.
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

    Estimators of the submission run as its suite names them, blind; other code of it does not run.
    Raises UsageError for a folder that is not a run, without rows, whose suite names files that are
    not there, on the path of Python, and for cells of sealed plants without their seed.
    """
    from sysid_bench.commands.run_folder import no_rows, open_run
    from sysid_bench.experiments.spec import SEALED, seed_of_hash
    from sysid_bench.harness.merge import contradictions
    from sysid_bench.harness.suite.model import Origin
    from sysid_bench.harness.work.row_files import ROWS_DIGEST, rows_digest

    if not 0 < share <= 1:
        raise UsageError(f"The share is {share:g}; give a part of the cells, above 0 and up to 1.")
    # Not from `random`, whose next numbers follow from earlier ones.
    chosen = secrets.randbelow(2**32) if seed is None else seed
    open_run(folder).check_path()
    read_submission(Path(folder))  # before cells run
    with without_frames(Path(folder)) as run:
        rows = run.rows()
        if not rows.rows:
            raise no_rows(open_run(folder))
        changed, digest = list(rows.garbled), rows_digest(run.path / "cells")
        if run.environment.get(ROWS_DIGEST, digest) != digest:
            changed.append(f"env.json ({ROWS_DIGEST})")
        # The suite with its files in the folder of the submission: models in robots/ of it.
        here = Path(folder).resolve()
        robots = str(here / "robots") if (here / "robots").is_dir() else None
        origin = Origin(folder=str(here), robots=robots)
        suite = run.suite.model_copy(update={"origin": origin})
        known, versions = run.planned_fields, [one.get("versions") for one in run.machines]
        other = [name for name, row in rows.rows.items() if row.get("versions") not in versions]
        found = {
            "rows of other versions than env.json states": other,
            "cells with ok rows of one code that differ": contradictions(run),
            **_beside_methods(run, suite),
        }
        try:
            planned = _not_of_the_suite(run, suite)
        except UsageError as error:  # as of a robot that is another one than its name says
            planned, found[f"cells of a suite that cannot be planned ({error})"] = [], [*known]
        refused = {why: cells for why, cells in found.items() if cells}
        ids = sorted(
            name
            for name, row in rows.rows.items()
            if name in known and row["status"] not in _OF_MACHINES
        )
        # Cells of another plan need no run to be refused, and their code is not executed.
        drawn = [] if planned or refused else random_cells(ids, share, chosen)
        for cell in run.plan.cells:
            seal = cell.spec.plant.get(SEALED)
            if seal and cell.id in drawn and rows.rows[cell.id]["status"] == "ok":
                seed_of_hash(str(seal))  # an error where it is not here
        different = _differences(run, suite, drawn, jobs, on_event) if drawn else []
    return CheckResult(
        folder=str(folder),
        seed=chosen,
        drawable=len(ids),
        cells=drawn,
        different=different,
        planned=planned,
        changed=changed,
        refused=refused,
        digest=digest,
    )


def _beside_methods(run: "RunFolder", suite: "Suite") -> dict[str, list[str]]:
    """Cells of experiments with third-party plug-ins that are not methods, by a sentence."""
    from sysid_bench.harness.run import job_of
    from sysid_bench.harness.suite.load_suite import third_party_names

    parts = ((c.id, job_of([c], suite, suite.robots_folder)["third_party"]) for c in run.plan.cells)
    cells = [name for name, code in parts if code["data"] or code["metrics"]]
    named = third_party_names(suite, suite.robots_folder)
    names = ", ".join(f"{kind} {name}" for kind, name in named if kind != "estimator")
    return {f"third-party code other than methods, which would see the truth ({names})": cells}


def _not_of_the_suite(run: "RunFolder", suite: "Suite") -> list[str]:
    """Ids of planned cells that the suite does not make, or makes with other labels."""
    from sysid_bench.harness.plan import cells_of_suite
    from sysid_bench.harness.worker_names import worker_names

    with worker_names(suite.robots_folder) as names:
        # From the suite, not from the plan of the submission, which could leave hard cells out.
        made = cells_of_suite(suite, names, large=True)
    wanted = {cell.id: cell.first_fields for cell in made.cells}
    planned = run.planned_fields
    # Records of other models would make it another version of the suite.
    stated, true = ({k: x["hash"] for k, x in one.items()} for one in (run.models, made.models))
    if run.models and stated != true:
        return [*planned]
    other = [name for name, head in planned.items() if wanted.get(name) != head]
    return other + [name for name in wanted if name not in planned]


def _differences(
    run: "RunFolder",
    suite: "Suite",
    cells: list[str],
    jobs: int | None,
    on_event: OnEvent | None,
) -> list[dict[str, Any]]:
    """Values of the cells that differ when they are run again: all metrics that are numbers and do
    not depend on the machine."""
    from sysid_bench.harness.comparison.run_difference import find_difference
    from sysid_bench.harness.comparison.run_values import read_run
    from sysid_bench.harness.run import run as execute
    from sysid_bench.metrics import METRICS, names_of
    from sysid_bench.words import MACHINE_FIELDS

    select = f"id in [{', '.join(map(repr, cells))}]".replace("'", '"')
    numbers = (name for name in names_of("cell") if not METRICS[name].text)
    # Times and memory differ on any machine, and do not indicate another answer.
    metrics = tuple(name for name in numbers if name not in MACHINE_FIELDS)
    with tempfile.TemporaryDirectory(prefix="sysid-bench-") as folder:
        again = execute(
            suite, Path(folder) / "again", jobs=jobs, select=select, on_event=on_event,
            robots_dir=suite.robots_folder, large=True,
        )  # fmt: skip
        computed = read_run(again.folder, metrics)
    changes = find_difference(computed, read_run(run, metrics), partial=True)
    return [
        {"id": one.cell, "metric": one.metric, "submitted": one.after, "computed": one.before}
        for one in changes.cells
        if one.cell in cells
    ]
