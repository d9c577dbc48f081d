"""Published values and repeated runs of recorded legs, as Markdown: `python -m
reports.make.actuators_claims [pace-claims|go2-repeat]`.

`pace-claims`: rollout errors of published values beside those of the fit, by the score of
`reports.make.actuators`; published values have the best delay of 0 to 20 ms, and the better of
both signs of their bias, on the judged samples. Values within 0.1 % of a bound are named.
`go2-repeat`: each run is left out in turn, and the ranges of the others are held against it.
"""

import json
import os
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np
from scipy.special import ndtri

from reports.make.actuators import RUNS, fitted, recording, scored
from sysid_bench.apps.actuators.bounded_fit import Group
from sysid_bench.apps.actuators.drive_estimate import DriveEstimate
from sysid_bench.apps.actuators.drive_rows import UNKNOWNS
from sysid_bench.apps.actuators.rollout import Drives
from sysid_bench.errors import SimulationError
from sysid_bench.evaluation.intervals import left_out_held
from sysid_bench.models.load import load_robot
from sysid_bench.types import Array

DELAYS: Final = 1e-3 * np.arange(0.0, 21.0, 2.5)
WORDS: Final = ("armature", "damping", "frictionloss")
BOUNDS: Final = {"bias": (-0.1, 0.1), "frictionloss": (0.0, 1.0)}
"""Bounds of the published searches, where they are known."""

NEAR: Final = 1e-3
LEVELS: Final = (0.90, 0.95)


def main() -> None:
    """Print the tables that are asked for."""
    data = Path(os.environ["SYSID_BENCH_DATA"])
    parts = {"pace-claims": _claims, "go2-repeat": _repeats}
    for name in sys.argv[1:] or parts:
        for line in parts[name](data):
            print(line, flush=True)


def _claims(data: Path) -> Iterator[str]:
    yield "| recording | values | rollout, mrad | delay, ms | on a bound |"
    yield "| --- | --- | ---: | ---: | --- |"
    for name, run in RUNS:
        robot = load_robot(data / name / f"{name}.xml")
        log = recording(data / name, run, robot)
        found = fitted(robot, log)
        words = (f"{scored(robot, log, found.drives):.2f}", f"{1e3 * found.delay:.1f}")
        bound = [
            f"{found.rows.joints[j]} {UNKNOWNS[i]}" for j, i in np.argwhere(found.fit.at_bound)
        ]
        yield _row(f"{name} {run}", "this fit", *words, bound)
        published = json.loads((data / name / "published.json").read_text(encoding="utf-8"))
        for label, values in published.items():
            if isinstance(values, dict):
                best = _best(robot, log, values["joints"])
                yield _row(f"{name} {run}", label, *best, _on_bound(values["joints"]))


def _row(recorded: str, values: str, error: str, delay: str, bound: list[str]) -> str:
    names = f"{len(bound)}: {', '.join(bound)}" if bound else "-"
    return f"| {recorded} | {values} | {error} | {delay} | {names} |"


def _best(robot: Any, log: Any, joints: Mapping[str, Mapping[str, float]]) -> tuple[str, str]:
    """Least rollout error (mrad) of published values over delays and signs of the bias, with the
    delay (ms)."""
    terms = [[joints[name][word] for word in WORDS] + [0.0] for name in log.joints]
    bias = np.array([joints[name].get("bias", 0.0) for name in log.joints])
    tried = []
    for sign in (-1.0, 1.0) if bias.any() else (0.0,):
        for delay in DELAYS:
            drives = Drives(log.joints, np.array(terms), float(delay), {"bias": sign * bias})
            try:
                tried.append((scored(robot, log, drives), float(delay)))
            except SimulationError:
                continue
    error, delay = min(tried)
    return f"{error:.2f}", f"{1e3 * delay:.1f}"


def _on_bound(joints: Mapping[str, Mapping[str, float]]) -> list[str]:
    return [
        f"{name} {word}"
        for name, values in joints.items()
        for word, (low, high) in BOUNDS.items()
        if word in values
        and min(abs(values[word] - low), abs(high - values[word])) <= NEAR * (high - low)
    ]


def textbook_std(group: Group, residuals: Array) -> Array:
    """Deviations (m, 4) of least squares with white residuals of one size."""
    r = residuals[:, group.joints].T.ravel()
    variance = float(r @ r) / (len(r) - group.A.shape[1])
    std = np.sqrt(variance * np.diag(np.linalg.pinv(group.A.T @ group.A, hermitian=True)))
    return np.array([std[group.columns(i)] for i in range(len(group.joints))])


def _textbook(found: DriveEstimate) -> Array:
    std = np.zeros_like(found.fit.values)
    for group in found.groups:
        std[list(group.joints)] = textbook_std(group, found.fit.residuals)
    return std


def _repeats(data: Path) -> Iterator[str]:
    runs = [run for name, run in RUNS if name == "go2"]
    robot = load_robot(data / "go2" / "go2.xml")
    logs = [recording(data / "go2", run, robot) for run in runs]
    found = [fitted(robot, log) for log in logs]
    values = np.array([one.fit.values for one in found])
    stds = {
        "residuals": np.array([one.fit.std for one in found]),
        "textbook": np.array([_textbook(one) for one in found]),
    }
    free = np.logical_not(np.array([one.fit.at_bound for one in found]).any(axis=0))
    yield "| values | joints | ranges | deviation over that between runs | 90 % hold | 95 % hold |"
    yield "| --- | ---: | --- | ---: | ---: | ---: |"
    for label, columns in [*((term, [i]) for i, term in enumerate(UNKNOWNS)), ("all", range(4))]:
        used = np.zeros_like(free)
        used[:, list(columns)] = free[:, list(columns)]
        if used.any():
            yield from _shares(label, values[:, used], {k: x[:, used] for k, x in stds.items()})
    own = [scored(robot, log, one.drives) for log, one in zip(logs, found, strict=True)]
    ratios = [
        scored(robot, logs[j], found[i].drives) / own[j] for i in runs for j in runs if i != j
    ]
    yield ""
    yield (
        f"Values of one run on another: {np.median(ratios):.2f} times its own rollout error "
        f"(median), {max(ratios):.2f} (worst); {sum(r <= 1.2 for r in ratios)} of {len(ratios)} "
        "pairs within 1.2."
    )


def _shares(label: str, values: Array, stds: Mapping[str, Array]) -> Iterator[str]:
    """Lines of one kind of values (n, c): ranges between files, then those of single fits."""
    between = values.std(axis=0, ddof=1)
    held = [float(np.mean(left_out_held(values, level))) for level in LEVELS]
    yield _share_row(label, values.shape[1], "between files, Student's t", 1.0, held)
    for source, std in stds.items():
        held = [_held(values, std, level) for level in LEVELS]
        ratio = float(np.median(std.mean(axis=0) / between))
        yield _share_row(label, values.shape[1], f"{source} of single fits", ratio, held)


def _share_row(label: str, count: int, source: str, ratio: float, held: list[float]) -> str:
    words = " | ".join(f"{100 * share:.0f} %" for share in held)
    return f"| {label} | {count} | {source} | {ratio:.2f} | {words} |"


def _held(values: Array, std: Array, level: float) -> float:
    """Share of the values that the mean of the other runs holds, +- z s sqrt(1 + 1/n), with s from
    their own deviations."""
    inside = []
    for k, own in enumerate(values):
        mean = np.delete(values, k, axis=0).mean(axis=0)
        s = np.sqrt(np.mean(np.delete(std, k, axis=0) ** 2, axis=0))
        reach = float(ndtri(0.5 + 0.5 * level)) * s * np.sqrt(1.0 + 1.0 / (len(values) - 1))
        inside.append(np.abs(own - mean) <= reach)
    return float(np.mean(inside))


if __name__ == "__main__":
    main()
