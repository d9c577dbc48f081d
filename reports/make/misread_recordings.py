"""Recordings that are misread or say little: what `diagnose` and `identify` make of them.

    SYSID_BENCH_DATA=... python -m reports.make.misread_recordings pairs|signals [NAME...]

`pairs`: the default method of recordings, trained on each motion of a data set and tested on each
other one. An answer is at most 1.1 times as bad as the worse of the null model (bodies of the file
with fitted friction) and of least squares cut off at 1e-6 of the largest singular value, or
`identify` exits with 3. `signals`: the first training and the first test motion
of each data set with other numbers in the place of a signal.
"""

from collections import Counter
from collections.abc import Iterator
from itertools import permutations

import click
import numpy as np

from reports.make.mistakes_to_plant import MISTAKES
from reports.make.recordings_to_diagnose import Subject, evidence, recorded_subjects
from sysid_bench.commands.identify import identify
from sysid_bench.diagnosis.finding import WARNING
from sysid_bench.diagnosis.run_checks import contradictions_left, diagnose
from sysid_bench.errors import UsageError
from sysid_bench.identification.linear.least_squares import row_noise, stacked_factor
from sysid_bench.models.data_sets import find_dataset
from sysid_bench.types import Estimate, Problem
from sysid_bench.words import FINDINGS

KINDS = (
    "torque = current", "torque = acceleration", "torque = velocity", "torque = position",
    "q = velocity", "v = position",
)  # fmt: skip


class Truncated:
    """beta = W^+ b on unit columns, singular values below 1e-6 of the largest dropped."""

    bias = "weakly excited directions are zero"

    def solve(self, problem: Problem) -> Estimate:
        """Return beta (r,)."""
        R = stacked_factor(problem, (1.0 / row_noise(problem)).tolist())
        size = np.linalg.norm(R[:, :-1], axis=0)
        size = np.where(size > 0, size, 1.0)
        return Estimate(np.linalg.lstsq(R[:, :-1] / size, R[:, -1], rcond=1e-6)[0] / size)


def pairs(name: str) -> Iterator[tuple[str, float, float, float, bool]]:
    """Yield train -> test, the errors of the answer, of the null model and of the truncated fit,
    and whether `identify` exits with 3."""
    motions, robot = find_dataset(name).described.motions, f"dataset:{name}"
    bare = [f"{robot}/{key}" for key, keys in motions.items() if "payload" not in keys]
    for train, test in permutations(bare, 2):
        found = identify(robot, log=train, test=test, accept=FINDINGS)
        cut = identify(
            robot, log=train, test=test, accept=(*FINDINGS, "worse"),
            estimator="reports.make.misread_recordings:Truncated",
        )  # fmt: skip
        label = " -> ".join(one.rpartition("/")[2] for one in (train, test))
        error, null, rival = (
            float(x or np.nan)
            for x in (found.torque_error, found.torque_error_null, cut.torque_error)
        )
        yield label, error, null, rival, found.failure is not None


def print_pairs(names: list[str]) -> None:
    """Print a line for each data set, and the pairs that exit with 3."""
    print("| data set | pairs | answered | exit 3 | largest error over the worse rival |")
    print("|---|---:|---:|---:|---:|")
    refused, total = [], Counter[str]()
    for name in names:
        rows = list(pairs(name))
        ratios = [error / max(null, cut) for _, error, null, cut, fails in rows if not fails]
        refused += [(name, *row[:4]) for row in rows if row[4]]
        total.update(pairs=len(rows), answered=len(ratios), worse=sum(r > 1.1 for r in ratios))
        worst = f"{max(ratios):.2f}" if ratios else "-"
        counts = f"{len(rows)} | {len(ratios)} | {len(rows) - len(ratios)}"
        print(f"| {name} | {counts} | {worst} |", flush=True)
    print(f"\n{dict(total)}\n")
    print("| exit 3 | motions | error | null model | truncated |\n|---|---|---:|---:|---:|")
    for name, label, *errors in refused:
        print(f"| {name} | {label} | {' | '.join(f'{x:.3g}' for x in errors)} |")


def judged(one: Subject, kind: str) -> str:
    """Return refused, warned or silent, of a recording with other numbers in a signal."""
    (mistake,) = (m for m in MISTAKES if m.name == kind)
    try:
        faulty = evidence(mistake.change(one.training, 0, np.random.default_rng(0)), one.robot)
    except UsageError:
        return "refused"
    found = diagnose(faulty)
    if contradictions_left(found, one.accepted):
        return "refused"
    return "warned" if any(f.severity == WARNING for f in found) else "silent"


def print_signals(names: list[str]) -> None:
    """Print how many recordings are refused, warned of or silent, by what stands in a signal."""
    counts = {kind: Counter[str]() for kind in KINDS}
    others = []
    for one in (one for name in names for one in recorded_subjects(name)):
        for kind in KINDS:
            verdict = judged(one, kind)
            counts[kind][verdict] += 1
            others += [f"- {one.name}, {kind}: {verdict}"] if verdict != "refused" else []
    print("| numbers | recordings | refused | warned | silent |\n|---|---:|---:|---:|---:|")
    for kind, found in counts.items():
        numbers = (found.total(), found["refused"], found["warned"], found["silent"])
        print(f"| {kind} | {' | '.join(map(str, numbers))} |")
    print("\n" + "\n".join(others))


@click.command()
@click.argument("table", type=click.Choice(["pairs", "signals"]))
@click.argument("names", nargs=-1)
def main(table: str, names: tuple[str, ...]) -> None:
    """Print one of the tables, of all data sets or of some."""
    chosen = list(names)
    if not chosen:
        chosen = list(dict.fromkeys(one.name.partition("/")[0] for one in recorded_subjects()))
    print_pairs(chosen) if table == "pairs" else print_signals(chosen)


if __name__ == "__main__":
    main()
