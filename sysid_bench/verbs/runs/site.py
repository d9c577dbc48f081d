"""The command `site`: runs and checked submissions as a static site of results."""

import os
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from sysid_bench.apps.site.site_pages import LEADERBOARD, site_pages
from sysid_bench.apps.site.suite_version import RepeatShare, SiteRun, Submission
from sysid_bench.canonical_json import canonical
from sysid_bench.commands.result import Result
from sysid_bench.errors import UsageError
from sysid_bench.harness.fingerprint import other_code, stale_note
from sysid_bench.harness.work.supervise import OnEvent
from sysid_bench.input_files import is_file, parse_toml, read_text
from sysid_bench.verbs.runs.report import row_selection
from sysid_bench.verbs.runs.run_folder import no_rows, open_run
from sysid_bench.verbs.runs.submission import (
    SHARE,
    CheckResult,
    check_submission,
    read_submission,
    without_frames,
)

if TYPE_CHECKING:
    from sysid_bench.harness.stored_run import RunFolder

_OWN: Final = ("suites", "robots", "methods")
"""Folders of a site, which are made anew."""


@dataclass(frozen=True, eq=False, repr=False)
class SiteResult(Result):
    """A site in `folder` (None where nothing is written): its files, and the checks of
    submissions."""

    folder: str | None
    files: list[str]
    checks: tuple[CheckResult, ...]

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


def site(
    runs: Sequence[str | Path] = (),
    out: str | Path | None = None,
    submissions: Sequence[str | Path] = (),
    seed: int | None = None,
    *,
    share: float = SHARE,
    jobs: int | None = None,
    on_event: OnEvent | None = None,
) -> SiteResult:
    """Write the site of some runs, and of `submissions` whose check finds no difference, into the
    folder `out`; without it, only check the submissions.

    `seed` and `share` (0 to 1) decide which cells of each submission run again. A site that is
    there is replaced. Raises UsageError for a folder that is not a run or without rows, and for an
    `out` with other files.
    """
    _check_request(runs, out, submissions)
    read = [_site_run(open_run(run), Path(run).resolve().name, is_own=True) for run in runs]
    checks = tuple(check_submission(one, seed, share, jobs, on_event) for one in submissions)
    if out is None or not all(check.ok for check in checks):
        return SiteResult(None, [], checks)
    pages = site_pages([*read, *map(_submitted_run, checks)])
    _write(Path(out), pages)
    return SiteResult(str(out), sorted(pages), checks)


def _check_request(
    runs: Sequence[str | Path], out: str | Path | None, submissions: Sequence[str | Path]
) -> None:
    """Raise UsageError, before anything runs, for a request that gives no site."""
    if not runs and not submissions:
        raise UsageError("A site needs runs: 'sysid-bench site RUN... -o site', or --check FOLDER.")
    if runs and out is None:
        raise UsageError("A site of runs needs a folder: -o site.")
    if out is not None:
        _check_folder(Path(out))


def _submitted_run(check: CheckResult) -> SiteRun:
    folder = Path(check.folder)
    with without_frames(folder) as rows:
        facts = read_submission(folder)
        return _site_run(rows, folder.resolve().name, submission=facts, checked=check.share)


def _site_run(
    run: "RunFolder",
    name: str,
    submission: Submission | None = None,
    checked: RepeatShare | None = None,
    *,
    is_own: bool = False,
) -> SiteRun:
    """Rows and origin of a run."""
    cells = run.frames().cells
    if len(cells) == 0:
        raise no_rows(run)
    note = stale_note(other_code(run, run.row_counts())) if is_own else ""
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
        notes=tuple(filter(None, [note])),
        submission=submission,
        checked=checked,
    )


def _check_folder(out: Path) -> None:
    """Raise UsageError for a folder with files that are not of a site."""
    if out.exists() and not is_file(out / LEADERBOARD) and (not out.is_dir() or any(out.iterdir())):
        raise UsageError(
            f"{str(out)!r} is there and not a site: it has no {LEADERBOARD}. Choose another -o."
        )


def _write(out: Path, pages: dict[str, str]) -> None:
    """Write all pages in place of those of an earlier site; leaderboard.json last."""
    for folder in _OWN:
        shutil.rmtree(out / folder, ignore_errors=True)
    for path in sorted(pages, key=lambda name: name == LEADERBOARD):
        file = out / path
        file.parent.mkdir(parents=True, exist_ok=True)
        part = file.with_name(f".{file.name}.{os.getpid()}")
        part.write_text(pages[path], encoding="utf-8")
        part.replace(file)
