"""CPU time of running a third-party method in a process of its own.

python -m reports.make.blind_overhead [COUNT] prints medians of COUNT processes: their start, until
the method is built, and a cell, from sending its data to its estimate, of a method that takes no
rows and of one that takes all of them, without the time in which that computes its regressor. CPU
seconds of this process, and of the method's with all that it has started.
"""

import statistics
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from sysid_bench.types import Estimate, Problem

CASES = {
    "scara, 2 s at 200 Hz": ("scara", "2 s", "200 Hz"),
    "panda, 10 s at 1 kHz": ("panda", "10 s", "1 kHz"),
}


class WithoutRows:
    """A method that looks at nothing."""

    def solve(self, problem: Problem) -> Estimate:
        """Return zeros (r,)."""
        return Estimate(np.zeros(problem.base.rank))


class AllRows:
    """A method that asks for the regressor."""

    def solve(self, problem: Problem) -> Estimate:
        """Return zeros (r,), and the time of the regressor."""
        before = time.process_time()
        columns = problem.W.shape[1]
        return Estimate(np.zeros(columns), stats={"rows": time.process_time() - before})


def experiment(robot: str, period: str, rate: str) -> Any:
    """The data of an experiment, as a worker has them before its first cell."""
    from sysid_bench.experiments.execute import load_experiment, prepare
    from sysid_bench.harness.plan import cells_of_suite
    from sysid_bench.harness.run import job_of
    from sysid_bench.harness.suite.load_suite import parse_suite

    suite = parse_suite(f"""
        schema = 1
        name = "one"
        [defaults]
        excitation = {{ use = "fourier", period = "{period}", cycles = 1 }}
        rate = "{rate}"
        noise = {{ tau = "1 %" }}
        [[robot]]
        use = "{robot}"
        [[estimator]]
        use = "ols"
        """)
    (cell,) = cells_of_suite(suite).cells
    return prepare(*load_experiment(job_of([cell], suite, None)))


def measured(prepared: Any, method: str) -> tuple[float, float, float]:
    """CPU seconds of a start, of a cell, and of the regressor in it."""
    from sysid_bench.harness.work.blind_process import blind_method

    settings = {"use": f"file:{__file__}:{method}"}
    with tempfile.TemporaryDirectory() as folder:
        before = time.process_time()
        with blind_method(settings, Path(folder), simulated=True, sealed=False) as blind:
            start = time.process_time() - before + blind._cpu()
            before = time.process_time() + blind._cpu()
            rows = float(blind.solve(prepared.problem).stats.get("rows", 0.0))
            return start, time.process_time() + blind._cpu() - before - rows, rows


def main(count: str = "10") -> None:
    """Print the table."""
    print("| data | start | cell without rows | cell with all rows, beyond | the regressor |")
    print("| --- | --- | --- | --- | --- |")
    for title, case in CASES.items():
        prepared = experiment(*case)
        both = [[measured(prepared, method) for method in ("WithoutRows", "AllRows")]
                for _ in range(int(count))]  # fmt: skip
        parts = {
            "start": [one[0] for pair in both for one in pair],
            "without": [first[1] for first, _ in both],
            "with": [second[1] for _, second in both],
            "rows": [second[2] for _, second in both],
        }
        cells = " | ".join(f"{1e3 * statistics.median(one):.0f} ms" for one in parts.values())
        print(f"| {title} | {cells} |")


if __name__ == "__main__":
    main(*sys.argv[1:])
