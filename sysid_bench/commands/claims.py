"""Verb `claims`: published claims with verdicts, from the stored rows of runs."""

import shlex
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, get_args

from sysid_bench.commands.request import FAILED, OK, Request, argument, option
from sysid_bench.commands.result import HIDDEN, Result, value_text
from sysid_bench.errors import UsageError, count_text, unknown_name

if TYPE_CHECKING:
    import pandas as pd

    from sysid_bench.harness.stored_run import RunFolder
    from sysid_bench.harness.suite.report_entries import Claim
    from sysid_bench.reporting.claims import ClaimFinding
    from sysid_bench.reporting.text_table import TextTable

    Asked = dict[tuple[str, Claim], tuple[RunFolder, ...]]

FORMATS: Final = ("md", "csv", "latex")
_FRAMES: Final = {"joint": "by_joint", "interval": "by_std_from"}
_HEAD: Final = (
    "claim", "level", "verdict", "statistic", "value", "95 % interval", "wanted", "over",
    "can hold with", "p", "p, corrected", "cells", "lost", "gate", "suite", "reason",
)  # fmt: skip
_NOTES: Final = (
    "Holds, fails: the whole interval lies on one side of the threshold, and so does that at the "
    "level that the correction asks for. Open: it straddles it, or there is none (fewer than six "
    "robots, or what the claim counts in their place). p: the smallest 1 - level at which the "
    "interval decides; corrected over all verdicts of this table that have one (Benjamini and "
    "Hochberg 1995), so that of those decided at most one in twenty is false in the mean. Ranks, "
    "coverages and left-out have none: an interval of the bootstrap decides, uncorrected. Can hold "
    "with: the fewest units that can show it, all agreeing, beside others that are decided as "
    "clearly: the correction may ask for more. Exact: a statement of algebra, of every cell.",
    "Ratio: exp of the median over robots of the mean log ratio of their cells; a cell without an "
    "answer (lost) counts as one of the reference. Coverage and share: mean over robots. "
    "Intervals: order statistics of medians and ratios; of ranks and coverages percentile "
    "bootstrap over robots; of shares that of Clopper and Pearson (at least 95 %). None over "
    "cells, nor of coverages without spread.",
)


class Claims(Request["ClaimsResult"]):
    """Test the claims of runs on their stored rows: holds, fails, open or not testable."""

    runs: tuple[str | Path, ...] = argument("RUN...", several=True, complete="runs folders")
    suite: str | Path | None = option(
        "Suite whose claims are tested, in place of those of the runs.",
        default=None, complete="suites files",
    )  # fmt: skip

    def run(self) -> "ClaimsResult":
        """Return the claims with their verdicts."""
        from sysid_bench.commands.run_folder import condition, holds, no_rows, open_run
        from sysid_bench.evaluation.intervals import at_level
        from sysid_bench.reporting.claims import ClaimRows, claim_findings, correct_findings

        folders = [open_run(run) for run in self.runs]
        for folder in folders:
            if not folder.row_counts().rows:
                raise no_rows(folder)
        paths = [str(run) for run in self.runs]
        asked = _asked(folders, self.suite)
        if not asked:
            where = f"The suite {str(self.suite)!r}" if self.suite else ", ".join(paths)
            raise UsageError(f"{where} has no [[claim]]; name a suite that has: --suite FILE.")
        findings: list[ClaimFinding] = []
        for (suite, claim), used in asked.items():
            metrics = {name: one for folder in used for name, one in folder.suite.metrics.items()}
            rows = ClaimRows(
                suite=suite,
                lines=partial(_lines, used),
                choose=holds,
                fields=lambda text: condition(text).fields,
                metrics=metrics,
            )
            with at_level(used[0].suite.confidence):
                findings += claim_findings(claim.model_dump(), rows)
        words = ["sysid-bench", "claims", *paths]
        words += ["--suite", str(self.suite)] if self.suite else []
        with at_level(folders[0].suite.confidence):
            return _result(paths, correct_findings(findings), shlex.join(words))


class ClaimsCommand(Claims):
    form: str | None = option(
        "md, csv or latex; default: drawn, piped as md.",
        default=None, flags="--format", complete="formats",
    )  # fmt: skip
    gate: bool = option("Exit code 1 unless claims with gate = true hold.", default=False)

    def shell(self, as_json: bool) -> int:
        from sysid_bench.commands.terminal import print_json, print_table

        result = self.run()
        if as_json:
            print_json(result)
        else:
            print_table(result.text(self.form or "md"), self.form)
        return FAILED if self.gate and not result.ok else OK


def claims(*runs: str | Path, suite: str | Path | None = None) -> "ClaimsResult":
    """Test claims on the rows that runs stored.

    The claims are those of `suite` on the rows of all runs together, else those that the runs
    themselves have frozen, each on the rows of the runs that have it. Raises UsageError for a
    folder that is not a run, and where there is no claim.
    """
    return Claims(runs, suite).run()


def claims_of(run: "RunFolder") -> "ClaimsResult | None":
    """Return the claims of a run on its own rows; None where its suite has none."""
    return claims(run.path) if run.suite.claim else None


@dataclass(frozen=True, eq=False, repr=False)
class ClaimsResult(Result):
    """Verdicts on claims: `counts` by verdict; `failed` names the gates that do not hold. Each of
    `claims` has its suite, statement, source, level, verdict with a reason, figure and numbers of
    robots."""

    runs: list[str]
    counts: dict[str, int]
    failed: list[str]
    claims: list[dict[str, Any]]
    listing: "TextTable" = field(metadata=HIDDEN)
    command: str = field(metadata=HIDDEN)

    @property
    def ok(self) -> bool:
        """True where every gate holds: an open or untestable one fails."""
        return not self.failed

    def summary(self) -> str:
        """The table in Markdown, counts, and what becomes of the gates."""
        from sysid_bench.reporting.text_table import to_markdown

        counts = ", ".join(f"{count} {verdict}" for verdict, count in self.counts.items())
        parts = [to_markdown(self.listing).rstrip(), counts + "."]
        if self.failed:
            lost = (claim for claim in self.claims if claim["gate"] and claim["verdict"] != "holds")
            why = (": ".join(filter(None, (one["verdict"], one["reason"]))) for one in lost)
            named = (f"{name} ({text})" for name, text in zip(self.failed, why, strict=True))
            parts.append(f"A gate fails: {', '.join(named)}.")
        return "\n\n".join(parts)

    def text(self, form: str) -> str:
        """The table as "md", "csv" or "latex"."""
        from sysid_bench.commands.paper import text_of
        from sysid_bench.reporting.latex import Origin

        if form not in FORMATS:
            raise unknown_name("format", form, FORMATS)
        if form == "md":
            return self.summary() + "\n"
        command = f"{self.command} --format latex"
        return text_of(self.listing, form, Origin(", ".join(self.runs), "", command))


def _asked(folders: "Sequence[RunFolder]", suite: str | Path | None) -> "Asked":
    """Runs by the name of a suite and one of its claims: two suites may claim alike."""
    from sysid_bench import package_folders
    from sysid_bench.harness.suite.load_suite import load_suite
    from sysid_bench.harness.suite.names import static_names

    if suite is not None:
        # Verdicts need the rows alone: no code of the suite's plug-ins is run.
        read = load_suite(package_folders.suite(str(suite)), static_names())
        return {(read.name, claim): tuple(folders) for claim in read.claim}
    asked: Asked = {}
    for folder in folders:
        for claim in folder.suite.claim:
            key = (folder.suite.name, claim)
            asked[key] = (*asked.get(key, ()), folder)
    return asked


def _lines(folders: "tuple[RunFolder, ...]", kind: str) -> "pd.DataFrame":
    """Lines of all runs, with the run of each."""
    import pandas as pd

    from sysid_bench.reporting.claims import CONTENT, RUN
    from sysid_bench.words import LEFT_OUT

    name = "by_value" if kind == LEFT_OUT else _FRAMES.get(kind, "cells")
    frames: list[pd.DataFrame] = [getattr(folder.frames(), name) for folder in folders]
    parts = [frame.assign(**{RUN: str(n)}) for n, frame in enumerate(frames)]
    models = [folder.models for folder in folders]
    if len(models) > 1 and all(models):
        # Two files of one stem are two robots, and one robot under two names is one.
        hashes = [{name: one["hash"] for name, one in records.items()} for records in models]
        known = zip(parts, hashes, strict=True)
        parts = [p.assign(**{CONTENT: p["robot"].map(h).fillna(p["robot"])}) for p, h in known]
    # Empty frames are left out: their columns of objects would change the types of the others.
    return pd.concat([part for part in parts if len(part)] or parts, ignore_index=True)


def _listed(found: "ClaimFinding") -> tuple[str, ...]:
    """Line of a finding in the table of claims."""
    return (
        found.name, found.level, found.verdict, found.statistic, value_text(found.value),
        "-" if found.low is None else f"{found.low:.4g} to {found.high:.4g}", found.wanted,
        count_text(found.count, found.over) if found.count else "-",
        "-" if found.needed is None else str(found.needed),
        "exact" if found.exact else value_text(found.p), value_text(found.p_corrected),
        str(found.cells), str(found.lost), "yes" if found.gate else "", found.suite, found.reason,
    )  # fmt: skip


def _result(runs: list[str], findings: "Sequence[ClaimFinding]", command: str) -> ClaimsResult:
    from sysid_bench.evaluation.intervals import with_level
    from sysid_bench.evaluation.robot_statistic import Verdict
    from sysid_bench.reporting.text_table import TextTable

    verdicts = [found.verdict for found in findings]
    statements = dict.fromkeys(
        f"{found.suite}, {found.name}: {found.statement} ({found.source})"
        + (f". Source: \u201c{found.sentence}\u201d" if found.sentence else "")
        + (f". Protocol: {found.protocol}" if found.protocol else "")
        for found in findings
    )
    # A gate stands behind the name of its suite where there are several.
    several = len({found.suite for found in findings}) > 1
    failed = [
        f"{f'{found.suite}, ' if several else ''}{found.name} at {found.level}"
        for found in findings
        if found.gate and found.verdict != "holds"
    ]
    rows = tuple(map(_listed, findings))
    head, notes = tuple(map(with_level, _HEAD)), tuple(map(with_level, _NOTES))
    return ClaimsResult(
        runs=runs,
        counts={name: verdicts.count(name) for name in get_args(Verdict)},
        failed=failed,
        claims=[asdict(found) for found in findings],
        listing=TextTable("claims", "Claims", head, rows, (*notes, *statements)),
        command=command,
    )
