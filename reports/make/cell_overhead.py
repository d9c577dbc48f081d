"""CPU time that the harness takes for a cell whose method takes none.

python -m reports.make.cell_overhead [EXPERIMENTS] prints ms of CPU for each cell, of runs with
one and with ten estimators per experiment: those of a run with all experiments less those of a run
with a tenth, over the difference of their cells. Consolidation and the plan are included.
"""

import os
import sys
import tempfile
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[2] / "tests" / "harness"))

from harness_world import NAMES, small

from sysid_bench.harness.run import run
from sysid_bench.harness.suite.load_suite import parse_suite


def cpu_of_run(experiments: int, estimators: int) -> float:
    """Return the seconds of CPU of a run with trivial cells, those of its worker included."""
    entries = "".join(
        f'[[estimator]]\nuse = "ols"\nlabel = "m{k}"\nnumber = {k}\n' for k in range(estimators)
    )
    body = f'[run]\nrepeats = {experiments}\n[defaults]\nnoise = {{ tau = "1 %" }}'
    suite = parse_suite(small(body, estimators=entries), names=NAMES)
    before = sum(os.times()[:4])
    with tempfile.TemporaryDirectory() as name:
        done = run(suite, Path(name) / "run", jobs=1, names=NAMES, call="harness_tasks:execute")
        seconds = sum(os.times()[:4]) - before
        if len(done.folder.rows().rows) != experiments * estimators:
            raise RuntimeError(f"The run has other rows; its exit code is {done.exit_code}.")
    return seconds


def main(experiments: str = "2000") -> None:
    """Print the overhead."""
    most = int(experiments)
    few = max(1, most // 10)
    for estimators in (1, 10):
        cpu_of_run(1, estimators)  # imports
        seconds = cpu_of_run(most, estimators) - cpu_of_run(few, estimators)
        each = 1e3 * seconds / (estimators * (most - few))
        print(f"{estimators:2d} estimators per experiment: {each:.3f} ms of CPU per cell")


if __name__ == "__main__":
    main(*sys.argv[1:])
