"""Planted mistakes: what `sysid-bench diagnose` finds of them, and what they cost.

    SYSID_BENCH_DATA=... python -m reports.make.planted_mistakes [--cases] [--every N] [NAME...]

Every mistake is planted in recordings, with and without a tool that the model does not know, and
diagnosed; the cost is the raise of the error of a plain fit on other motions. A mistake that was
silent is not decidable where a robot near its model file (bodies within their spreads, any
friction, with a load or without) fits the faulty recording as well as the right one, at odds below
4 to 1: wrists whose torque is friction, uncertain masses, axes that gravity does not load.
Recordings whose data set states a contradiction are counted apart. NAME: a part of the
names of recordings, as `ur10e` or `sim:`; `--cases` prints each case; `--every N`: one of N
mistakes in each recording, other ones in the next.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import chain
from typing import Final

import click
import numpy as np

from reports.make.mistakes_to_plant import HARMLESS, MISTAKES, Mistake
from reports.make.recordings_to_diagnose import (
    SIMULATED,
    Subject,
    evidence,
    plain_error,
    recorded_subjects,
    simulated_subject,
    tool_mass,
    with_tool,
)
from sysid_bench.diagnosis.contradictions import DOUBTFUL
from sysid_bench.diagnosis.diagnose_input import DiagnoseInput
from sysid_bench.diagnosis.finding import NOTE, Finding
from sysid_bench.diagnosis.hypothesis import Hypothesis, first_hypothesis
from sysid_bench.diagnosis.run_checks import contradictions_left, diagnose
from sysid_bench.diagnosis.torque_candidates import load_unknowns, may_carry, with_load
from sysid_bench.errors import UsageError
from sysid_bench.types import Array

HARMFUL: Final = 0.3
"""Raise of the error from which a mistake must not stay silent."""
ABSURD: Final = 3.0
"""Factor of a gain in a cure, over the one that is right, beyond which it is absurd."""
UNDECIDED: Final = "undecided"
LOAD: Final = "load"
"""The finding of a tool, which is right where one was mounted."""


@dataclass(frozen=True)
class Case:
    """A mistake in a recording: the raise of the error of a plain fit, and what was found.

    `found`: severities and names in order; `named`: the right cause first; `refused`: an error, or
    unreadable; `absurd`: cures with a gain that is far from the right one.
    """

    recording: str
    mistake: str
    joint: str
    raised: float
    found: tuple[str, ...]
    named: bool
    refused: bool
    absurd: tuple[str, ...]
    text: str
    is_harmless: bool = False
    undecidable: bool = False
    shared: bool = False  # named as one of two explanations that are as likely

    @property
    def is_harmful(self) -> bool:
        """True where the mistake must not stay silent."""
        return not self.is_harmless and self.raised >= HARMFUL

    @property
    def is_silent(self) -> bool:
        """True where nothing but notes was found."""
        return not self.found

    @property
    def verdict(self) -> str:
        """One word."""
        if self.is_harmless:
            return "refused" if self.refused else "passed"
        if self.named:
            return "named"
        if self.undecidable:
            return "open"
        return "silent" if self.is_silent else "other"


@dataclass(frozen=True, eq=False)
class Bench:
    """A recording, with what is found in it and what a plain fit gives before any mistake."""

    subject: Subject
    loaded: bool = False

    @cached_property
    def tests(self) -> tuple[DiagnoseInput, ...]:
        """The other motions."""
        return tuple(evidence(test, self.subject.robot) for test in self.subject.tests)

    @cached_property
    def clean(self) -> DiagnoseInput:
        """The recording without a mistake."""
        return evidence(self.subject.training, self.subject.robot)

    @cached_property
    def findings(self) -> list[Finding]:
        """What is found in the recording without a mistake."""
        return _doubts(diagnose(self.clean), self.loaded)

    @cached_property
    def error(self) -> float:
        """Error of a plain fit to the recording without a mistake."""
        return plain_error(self.clean, self.tests)

    def case(self, mistake: Mistake, j: int) -> Case:
        """The mistake in joint j, diagnosed."""
        one, robot = self.subject, self.subject.robot
        robot = robot if mistake.robot is None else mistake.robot(robot)
        joint = one.training.joints[j] if mistake.of_joint else ""
        planted = mistake.change(one.training, j, np.random.default_rng(j))
        start = one.name, mistake.name, joint
        try:
            faulty = evidence(planted, robot)
        except UsageError as error:
            text = str(error)
            is_named = any(word in text for word in (*mistake.expected, "stamp", "gap"))
            found = ("error unreadable",)
            return Case(*start, np.inf, found, is_named, True, (), text, mistake.is_harmless)
        tests = tuple(replace(test, robot=robot) for test in self.tests)
        raised = plain_error(faulty, tests) - self.error
        # An error is new where the recording without the mistake has a warning.
        known = {(f.name, f.joints): f.is_error for f in self.findings}
        doubts = _doubts(diagnose(faulty), self.loaded)
        new = [f for f in doubts if known.get((f.name, f.joints), -1) < f.is_error]
        # No gain is right for the model of another robot, and none is absurd.
        cure = _right_gains(one.training.tau, planted.tau) if mistake.robot is None else None
        likely = _as_likely(new[0]) if new else []
        hits = [name in mistake.expected and (not joint or not js or joint in js)
                for name, js in likely]  # fmt: skip
        return Case(
            *start, raised, tuple(f"{f.severity} {f.name}" for f in new), any(hits),
            any(f.is_error for f in new), () if cure is None else tuple(_absurd(new, cure)),
            new[0].message if new else "", mistake.is_harmless,
            undecidable=not new and _is_undecidable(self.clean, faulty),
            shared=any(hits) and not hits[0],
        )  # fmt: skip


def _doubts(findings: Sequence[Finding], loaded: bool) -> list[Finding]:
    """Findings but notes, those that nothing is decided, and but the tool that is there, unless
    something else is as likely."""
    return [
        f for f in findings
        if f.severity != NOTE and f.name != UNDECIDED
        and not (loaded and f.name == LOAD and not f.as_likely)
    ]  # fmt: skip


def _as_likely(found: Finding) -> list[tuple[str, tuple[str, ...]]]:
    """Names and joints of a finding and of the explanations that it calls as likely."""
    others = [(one.name, one.joints) for one in found.alternatives if one.name in found.as_likely]
    return [(found.name, found.joints), *others]


def _is_undecidable(clean: DiagnoseInput, faulty: DiagnoseInput) -> bool:
    """True where the odds of the right recording against the faulty one are below 4 to 1."""
    right = first_hypothesis(clean)

    def score(h: Hypothesis) -> float:
        # A rate that is wrong changes the duration, and with it what the residuals count for.
        def of(one: Hypothesis) -> float:
            return replace(one.model, parts=right.model.parts).fit(one.mixing).score

        loaded = with_load(h) if may_carry(h) else None
        return min(of(h), np.inf if loaded is None else of(loaded) + load_unknowns(loaded))

    return score(first_hypothesis(faulty)) - score(right) < DOUBTFUL


def _right_gains(clean: Array, planted: Array) -> Array:
    """Factors (n,) that give back the clean torques (N, n), 1 where none does."""
    if planted.shape != clean.shape:
        return np.ones(clean.shape[1])
    valid = np.isfinite(planted).all(axis=1)
    x, y = planted[valid], clean[valid]
    size = (x**2).sum(axis=0)
    factor = (x * y).sum(axis=0) / np.where(size > 0, size, 1.0)
    exact = np.abs(y - factor * x).max(axis=0) <= 1e-9 * np.abs(y).max(axis=0)
    return np.where(exact & (factor != 0), np.abs(factor), 1.0)


def _absurd(findings: Sequence[Finding], cure: Array) -> Iterator[str]:
    """Cures with a gain far from the right one."""
    for one in findings:
        if "gain = [" in one.edit:
            numbers = one.edit.split("gain = [")[1].split("]")[0].split(",")
            gains = np.abs([float(x) for x in numbers])
            # A joint that the cure leaves alone may be one that this motion cannot decide.
            if (np.abs(np.log(gains / cure))[gains != 1] > np.log(ABSURD)).any():
                yield f"{one.severity} {one.name}: {one.message}"


def benches(name: str = "") -> Iterator[Bench]:
    """All recordings whose name holds a word, without a tool and with one."""
    simulated = (simulated_subject(one) for one in SIMULATED if name in f"sim:{one}")
    for one in chain(recorded_subjects(name), simulated):
        yield Bench(one)
        if tool_mass(one.robot) > 0:
            yield Bench(with_tool(one), loaded=True)


def cases_of(bench: Bench, part: int = 0, parts: int = 1) -> Iterator[Case]:
    """The mistakes of one recording, joint by joint in turn; every `parts`-th of them from `part`
    on."""
    for k, mistake in enumerate((*MISTAKES, *HARMLESS)):
        is_new = bench.subject.training.v is not None or not mistake.of_velocity
        if (k + part) % parts == 0 and is_new:
            yield bench.case(mistake, (k + part) % len(bench.subject.training.joints))


def table(cases: Sequence[Case], key: Callable[[Case], str], title: str) -> str:
    """Counts by recording or by mistake."""
    lines = [
        f"| {title} | planted | harmful | not decidable | right cause first (of the others) | "
        "as likely as another | silent | absurd factors | harmless: refused |",
        "|---|---:|---:|---:|---:|---:|---:|---:|---:|",
    ]
    groups = list(dict.fromkeys(key(case) for case in cases))
    for name in [*groups, ""]:
        some = [case for case in cases if key(case) == name or not name]
        mistakes = [case for case in some if not case.is_harmless]
        harmful = [case for case in some if case.is_harmful]
        harmless = [case for case in some if case.is_harmless]
        open_ones, decided = (
            [c for c in harmful if c.undecidable == value] for value in (True, False)
        )
        share = f"{sum(c.named for c in decided)} ({_percent([c.named for c in decided])})"
        refused = f"{sum(c.refused for c in harmless)} of {len(harmless)}" if harmless else ""
        numbers = [
            len(mistakes), len(harmful), len(open_ones), share, sum(c.shared for c in decided),
            sum(c.is_silent for c in decided), sum(bool(c.absurd) for c in some), refused,
        ]  # fmt: skip
        lines.append(f"| {name or '**together**'} | {' | '.join(map(str, numbers))} |")
    return "\n".join(lines)


def _percent(flags: Sequence[bool]) -> str:
    return f"{100 * sum(flags) / len(flags):.0f} %" if flags else "-"


def line(case: Case) -> str:
    """One case as a line of text."""
    absurd = " ABSURD" if case.absurd else ""
    return (
        f"{case.recording:32} {case.mistake:30} {case.joint:20} {case.raised:8.2f} "
        f"{case.verdict:8}{absurd} {'; '.join(case.found[:3])}: {case.text[:140]}"
    )


@click.command()
@click.option("--cases", "show_cases", is_flag=True)
@click.option("--every", default=1)
@click.option("--start", default=0, help="With --every: the first of the mistakes.")
@click.argument("names", nargs=-1)
def main(show_cases: bool, every: int, start: int, names: Sequence[str]) -> None:
    """Print the clean recordings that are refused, each case, and the tables."""
    cases: list[Case] = []
    refused = []
    apart = set()
    for k, bench in enumerate(one for name in names or [""] for one in benches(name)):
        accepted = bench.subject.accepted
        apart |= {bench.subject.name} if accepted else set()
        errors = [f.message for f in contradictions_left(bench.findings, accepted)]
        refused += [f"{bench.subject.name}: {text}" for text in errors]
        if show_cases:
            print(f"# {bench.subject.name}: error {bench.error:.3f}; {errors}", flush=True)
        for case in cases_of(bench, k + start, every):
            cases.append(case)
            if show_cases:
                print(line(case), flush=True)
    print(f"\nRecordings without a mistake that are refused: {'; '.join(refused) or 'none'}\n")
    of_accepted = [case for case in cases if case.recording in apart]
    cases = [case for case in cases if case.recording not in apart]
    print(table(cases, lambda case: case.recording, "recording"), "\n")
    print(table(cases, lambda case: case.mistake, "mistake"))
    if of_accepted:
        print("\nRecordings that contradict their model themselves, as their data set states:\n")
        print(table(of_accepted, lambda case: case.recording, "recording"))


if __name__ == "__main__":
    main()
