"""Published claims with verdicts, from the stored rows of runs."""

import shlex
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from functools import cache
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, get_args

import pandas as pd

from sysid_bench import package_folders
from sysid_bench.commands.result import Result, value_text
from sysid_bench.errors import UsageError, count_text, unknown_name
from sysid_bench.evaluation.robot_statistic import Verdict
from sysid_bench.harness.suite.expression import Expression
from sysid_bench.harness.suite.load_suite import load_suite
from sysid_bench.harness.suite.names import static_names
from sysid_bench.harness.suite.report_entries import Claim
from sysid_bench.reporting import latex
from sysid_bench.reporting.claims import RUN, ClaimFinding, ClaimRows, claim_findings
from sysid_bench.reporting.text_table import TextTable, to_csv, to_latex, to_markdown
from sysid_bench.verbs.runs.run_folder import no_rows, open_run
from sysid_bench.words import LEFT_OUT

if TYPE_CHECKING:
    from sysid_bench.harness.stored_run import RunFolder

FORMATS: Final = ("md", "csv", "latex")
VERDICTS: Final = get_args(Verdict)
_FRAMES: Final = {"joint": "by_joint", "interval": "by_std_from"}
_HEAD: Final = (
    "claim", "level", "verdict", "statistic", "value", "95 % interval", "wanted", "over",
    "cells", "lost", "gate", "suite", "reason",
)  # fmt: skip
_NOTES: Final = (
    "Holds, fails: the whole interval lies on one side of the threshold. Open: it straddles it, or "
    "there is none (fewer than six robots, or what the claim counts in their place).",
    "Ratio: exp of the median over robots of the mean log ratio of their cells; a cell without an "
    "answer (lost) counts as one of the reference. Coverage and share: mean over robots. "
    "Intervals: percentile bootstrap over robots; of shares that of Clopper and Pearson (at "
    "least 95 %). None over cells, nor of coverages without spread.",
)


@dataclass(frozen=True, eq=False, repr=False)
class ClaimsResult(Result):
    """Verdicts on claims: `counts` by verdict; `failed` names the gates that do not hold. Each of
    `claims` has its suite, statement, source, level, verdict with a reason, figure and numbers of
    robots."""

    runs: list[str]
    counts: dict[str, int]
    failed: list[str]
    claims: list[dict[str, Any]]
    listing: TextTable
    command: str

    @property
    def ok(self) -> bool:
        """True where every gate holds: an open or untestable one fails."""
        return not self.failed

    def summary(self) -> str:
        """The table in Markdown, counts, and what becomes of the gates."""
        counts = ", ".join(f"{count} {verdict}" for verdict, count in self.counts.items())
        return "\n\n".join([to_markdown(self.listing).rstrip(), counts + ".", *self._gates()])

    def _gates(self) -> list[str]:
        """A sentence on the gates that do not hold, with verdict and reason of each."""
        if not self.failed:
            return []
        lost = (claim for claim in self.claims if claim["gate"] and claim["verdict"] != "holds")
        why = (": ".join(filter(None, (claim["verdict"], claim["reason"]))) for claim in lost)
        named = (f"{name} ({text})" for name, text in zip(self.failed, why, strict=True))
        return [f"A gate fails: {', '.join(named)}."]

    def text(self, form: str) -> str:
        """The table as "md", "csv" or "latex"."""
        if form not in FORMATS:
            raise unknown_name("format", form, FORMATS)
        if form == "latex":
            command = f"{self.command} --format latex"
            return to_latex(self.listing, latex.Origin(", ".join(self.runs), "", command))
        return to_csv(self.listing) if form == "csv" else self.summary() + "\n"

    def _fields(self) -> dict[str, Any]:
        hidden = ("listing", "command")
        return {key: value for key, value in super()._fields().items() if key not in hidden}


def claims(*runs: str | Path, suite: str | Path | None = None) -> ClaimsResult:
    """Test claims on the rows that runs stored.

    The claims are those of `suite` on the rows of all runs together, else those that the runs
    themselves have frozen, each on the rows of the runs that have it. Raises UsageError for a
    folder that is not a run, and where there is no claim.
    """
    paths = [str(run) for run in runs]
    asked = _asked([_run_with_rows(run) for run in runs], suite)
    if not asked:
        where = f"The suite {str(suite)!r}" if suite else ", ".join(paths)
        raise UsageError(f"{where} has no [[claim]]; name a suite that has: --suite FILE.")
    findings = list(chain.from_iterable(_findings(*key, used) for key, used in asked.items()))
    words = ["sysid-bench", "claims", *paths, *(["--suite", str(suite)] if suite else [])]
    return _result(paths, findings, shlex.join(words))


def _run_with_rows(path: str | Path) -> "RunFolder":
    folder = open_run(path)
    if not folder.row_counts().rows:
        raise no_rows(folder)
    return folder


def claims_of(run: "RunFolder") -> ClaimsResult | None:
    """The claims of a run on its own rows; None where its suite has none."""
    return claims(run.path) if run.suite.claim else None


def _asked(
    folders: Sequence["RunFolder"], suite: str | Path | None
) -> "dict[tuple[str, Claim], tuple[RunFolder, ...]]":
    """Runs by the name of a suite and one of its claims: two suites may claim alike."""
    if suite is not None:
        # Verdicts need the rows alone: no code of the suite's plug-ins is run.
        read = load_suite(package_folders.suite(str(suite)), static_names())
        return {(read.name, claim): tuple(folders) for claim in read.claim}
    asked: dict[tuple[str, Claim], tuple[RunFolder, ...]] = {}
    for folder in folders:
        for claim in folder.suite.claim:
            key = (folder.suite.name, claim)
            asked[key] = (*asked.get(key, ()), folder)
    return asked


def _findings(suite: str, claim: Claim, used: "tuple[RunFolder, ...]") -> Iterable[ClaimFinding]:
    metrics = {name: one for folder in used for name, one in folder.suite.metrics.items()}
    rows = ClaimRows(
        suite=suite,
        lines=lambda kind: _lines(used, kind),
        choose=lambda text, row: _parsed(text).holds(row),
        fields=lambda text: _parsed(text).fields,
        metrics=metrics,
    )
    return claim_findings(claim.model_dump(), rows)


_parsed = cache(Expression.parse)


def _lines(folders: "tuple[RunFolder, ...]", kind: str) -> pd.DataFrame:
    """Lines of all runs, with the run of each."""
    parts = [_read(folder, kind).assign(**{RUN: str(n)}) for n, folder in enumerate(folders)]
    return pd.concat([part for part in parts if len(part)] or parts, ignore_index=True)


def _read(folder: "RunFolder", kind: str) -> pd.DataFrame:
    frames = folder.frames()
    if kind == LEFT_OUT:
        return frames.by_value
    found: pd.DataFrame = getattr(frames, _FRAMES.get(kind, "cells"))
    return found


def _result(runs: list[str], findings: Sequence[ClaimFinding], command: str) -> ClaimsResult:
    verdicts = [found.verdict for found in findings]
    return ClaimsResult(
        runs=runs,
        counts={name: verdicts.count(name) for name in VERDICTS},
        failed=_failed_gates(findings),
        claims=[asdict(found) for found in findings],
        listing=_listing(findings),
        command=command,
    )


def _failed_gates(findings: Sequence[ClaimFinding]) -> list[str]:
    """Names of the gates that do not hold, behind their suite where there are several."""
    several = len({found.suite for found in findings}) > 1
    return [
        f"{f'{found.suite}, ' if several else ''}{found.name} at {found.level}"
        for found in findings
        if found.gate and found.verdict != "holds"
    ]


def _listing(findings: Sequence[ClaimFinding]) -> TextTable:
    statements = dict.fromkeys(
        f"{found.suite}, {found.name}: {found.statement} ({found.source})" for found in findings
    )
    rows = tuple(map(_row, findings))
    return TextTable("claims", "Claims", _HEAD, rows, (*_NOTES, *statements))


def _row(found: ClaimFinding) -> tuple[str, ...]:
    count = count_text(found.count, found.over)
    return (
        found.name, found.level, found.verdict, found.statistic, value_text(found.value),
        "-" if found.low is None else f"{found.low:.4g} to {found.high:.4g}", found.wanted,
        count if found.count else "-", str(found.cells), str(found.lost),
        "yes" if found.gate else "", found.suite, found.reason,
    )  # fmt: skip
