"""CPU time and answers of the methods that simulate, beside those of an earlier commit.

python -m reports.make.simulating_estimators [COMMIT [ROBOT,... [METHOD,... [ROUNDS]]]] unpacks
the commit into a temporary folder with the compiled libraries of this one, starts a process in
either, and lets both solve the same problems in turn. Ratios are medians over the rounds of the CPU
time before to that now. Distances of answers are in standard deviations of the new one (cloe, clie,
rollout: Gauss-Newton stops at steps below 0.1), and relative to the norm of beta.
"""

import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from statistics import median
from typing import Any, Final

import numpy as np

from sysid_bench.evaluation.score import score
from sysid_bench.identification.identify import identify
from sysid_bench.plugin_names import build
from sysid_bench.types import Estimate
from tests.experiments.experiment_world import ready

BEFORE: Final = "b567162e"
"""The last commit before the methods that simulate were worked on."""

ROBOTS: Final = "random:1,smooth/robot.toml"
METHODS: Final = "cloe,clie,rollout,ekf,ukf"
RATES: Final = {"cloe": 100.0, "clie": 100.0}
"""Hz: as in the suite `methods`; rollouts and filters run at the 500 Hz of their authors."""

ROOT: Final = Path(__file__).parents[2]
LIBRARIES: Final = ("sysid_bench/regressors", "sysid_bench/simulation")


@cache
def problem_of(robot: str, rate: float) -> Any:
    """A closed loop at 1 kHz over 2 s, with 1 % of noise on the torques and a prior of 20 %."""
    return ready(
        robot=robot,
        rate=rate,
        simulation={"use": "closed-loop", "rate": "1 kHz"},
        excitation={"use": "fourier", "period": "2 s", "cycles": 1},
        noise={"q": 1e-5, "tau_relative": 0.01},
        signals={"filter": "butter 4 20 Hz zero-phase", "derivatives": "from q"},
    )


def answer(robot: str, method: str) -> dict[str, Any]:
    """CPU time, answer and error of one fit."""
    made = problem_of(robot, RATES.get(method, 500.0))
    estimator = build("estimator", method)
    start = time.process_time()
    found = identify(estimator, made.problem, made.experiment)
    seconds = time.process_time() - start
    if found.beta is None:
        return {"seconds": seconds, "status": found.reason}
    scored = score(Estimate(found.beta), made.problem, made.held_out, made.source.truth)
    covariance = np.zeros((0, 0)) if found.covariance is None else found.covariance
    return {
        "seconds": seconds,
        "status": "ok",
        "error": scored.torque_error,
        "beta": found.beta.tolist(),
        "covariance": covariance.tolist(),
        "simulations": getattr(found, "simulations", None),
    }


def serve() -> None:
    """Answer the problems named on standard input, one a line."""
    for line in sys.stdin:
        print(json.dumps(answer(*line.split())), flush=True)


@contextmanager
def unpacked(commit: str) -> Iterator[Path]:
    """The package of a commit in a temporary folder."""
    with tempfile.TemporaryDirectory() as folder:
        archive = subprocess.run(
            ["git", "archive", commit], cwd=ROOT, check=True, capture_output=True
        )
        subprocess.run(["tar", "-x", "-C", folder], input=archive.stdout, check=True)
        for place in LIBRARIES:
            for library in (ROOT / place).glob("lib*"):
                shutil.copy(library, Path(folder) / place)
        (Path(folder) / "reports/make").mkdir(parents=True, exist_ok=True)
        shutil.copy(__file__, Path(folder) / "reports/make")
        yield Path(folder)


def started(folder: Path) -> "subprocess.Popen[str]":
    """A process that answers, with one BLAS thread."""
    own = {"PYTHONPATH": str(folder), "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    return subprocess.Popen(
        [sys.executable, "-m", "reports.make.simulating_estimators", "--serve"],
        cwd=folder,
        env={**os.environ, **own},
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )


def asked(process: "subprocess.Popen[str]", robot: str, method: str) -> dict[str, Any]:
    """One answer of a process."""
    assert process.stdin is not None
    assert process.stdout is not None
    print(robot, method, file=process.stdin, flush=True)
    return dict(json.loads(process.stdout.readline()))


def compared(before: dict[str, Any], now: dict[str, Any]) -> str:
    """Errors, simulations and the distance of two answers, as cells of a table."""
    failed = [x["status"] for x in (before, now) if x["status"] != "ok"]
    if failed:
        return f"{failed[0][:60]} | | |"
    old, new = (np.array(x["beta"]) for x in (before, now))
    relative = f"{np.linalg.norm(new - old) / np.linalg.norm(old):.1e}"
    deviations = ""
    if now["covariance"]:
        step = np.linalg.solve(np.array(now["covariance"]), new - old) @ (new - old)
        deviations = f"{np.sqrt(max(step, 0.0) / len(old)):.2g}"
    errors = f"{before['error']:.4g}, {now['error']:.4g}"
    return f"{errors} | {now['simulations'] or ''} | {deviations} | {relative}"


def main(
    commit: str = BEFORE, robots: str = ROBOTS, methods: str = METHODS, rounds: str = "3"
) -> None:
    """Print the table of ratios."""
    print(
        "| robot | method | CPU s before | now | ratio | errors | simulations | deviations | beta |"
    )
    print("| --- | --- | ---: | ---: | ---: | --- | ---: | ---: | ---: |")
    with unpacked(commit) as folder:
        pair = [started(folder), started(ROOT)]
        for robot in robots.split(","):
            for method in methods.split(","):
                found = [[asked(x, robot, method) for x in pair] for _ in range(int(rounds))]
                ratio = median(before["seconds"] / now["seconds"] for before, now in found)
                times = (
                    f"{median(x['seconds'] for x in side):.3g}" for side in zip(*found, strict=True)
                )
                cells = " | ".join((robot, method, *times, f"{ratio:.2f}", compared(*found[-1])))
                print(f"| {cells} |", flush=True)
        for process in pair:
            process.communicate()


if __name__ == "__main__":
    if sys.argv[1:] == ["--serve"]:
        serve()
    else:
        main(*sys.argv[1:])
