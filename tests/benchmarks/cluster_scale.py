"""Many empty cells, or the cells of a suite, on Dask workers of this machine and on local ones.

python -m tests.benchmarks.cluster_scale empty [CELLS] prints, for two workers of the executors
`local` and `dask`: seconds on the clock, CPU per cell of the client, its peak memory, and the rows
found. python -m tests.benchmarks.cluster_scale suite SUITE [SELECT] prints the seconds on the clock
of one and two workers of either executor, plan and consolidation included, on an idle machine.
"""

import contextlib
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

from sysid_bench.harness.run import run
from sysid_bench.harness.suite.load_suite import load_suite, parse_suite
from tests.cluster.cluster_world import ROOT, Cluster

HARNESS = ROOT / "tests" / "harness"
ESTIMATORS = 100
"""Per experiment, so that a batch has the 2000 cells that it may have."""


def main(kind: str = "empty", *words: str) -> None:
    """Print the table of a kind; each run has a process of its own, whose memory is measured."""
    runs = [("local", "2"), ("dask", "2")]
    if kind == "suite":
        runs += [("local", "1"), ("dask", "1")]
    for executor, workers in runs:
        command = [sys.executable, "-m", __spec__.name, f"one-{kind}", executor, workers, *words]
        subprocess.run(command, cwd=ROOT, check=True)


def empty(executor: str, workers: str, cells: str = "20000") -> None:
    """Run cells whose method takes no time."""
    sys.path.insert(0, str(HARNESS))
    from harness_world import NAMES, small

    entries = "".join(
        f'[[estimator]]\nuse = "ols"\nlabel = "m{k}"\nnumber = {k}\n' for k in range(ESTIMATORS)
    )
    body = f'[run]\nrepeats = {int(cells) // ESTIMATORS}\n[defaults]\nnoise = {{ tau = "1 %" }}'
    suite = parse_suite(small(body, estimators=entries), names=NAMES)
    with _address(executor, int(workers)) as address, tempfile.TemporaryDirectory() as name:
        start, before = time.perf_counter(), time.process_time()
        done = run(
            suite, Path(name) / "run", jobs=int(workers), names=NAMES, large=True, executor=address,
            call="harness_tasks:execute",
        )  # fmt: skip
        seconds, cpu = time.perf_counter() - start, time.process_time() - before
        memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
        found = len(done.folder.first_fields().rows)
        sizes = _sizes(done.folder.path)
    print(
        f"{executor:5s} {workers} workers: {seconds:7.1f} s; client: {1e3 * cpu / int(cells):.3f} "
        f"ms of CPU per cell, {memory:.2f} GB; {found} of {cells} rows; {sizes}",
        flush=True,
    )


def _sizes(folder: Path) -> str:
    """Sizes of the plan, of the rows and of the columns of a run."""
    files = {"plan": "plan.jsonl", "rows": "cells/*.jsonl", "columns": "*.parquet"}
    parts = (
        f"{name} {sum(file.stat().st_size for file in folder.glob(pattern)) / 1e6:.1f} MB"
        for name, pattern in files.items()
    )
    return ", ".join(parts)


def suite(executor: str, workers: str, file: str, select: str | None = None) -> None:
    """Run the cells of a suite."""
    with _address(executor, int(workers)) as address, tempfile.TemporaryDirectory() as name:
        start = time.perf_counter()
        done = run(
            load_suite(Path(file)), Path(name) / "run", jobs=int(workers), select=select,
            executor=address,
        )  # fmt: skip
        seconds = time.perf_counter() - start
        found = len(done.folder.first_fields().rows)
    print(f"{executor:5s} {workers} workers: {seconds:7.1f} s, {found} rows", flush=True)


@contextlib.contextmanager
def _address(executor: str, workers: int) -> Iterator[str]:
    """Yield the name of an executor; a scheduler and its workers are started for `dask`."""
    if executor == "local":
        yield "local"
        return
    with tempfile.TemporaryDirectory() as name:
        cluster = Cluster(Path(name))
        try:
            for _ in range(workers):
                cluster.join(path=Path(f"{ROOT}{os.pathsep}{HARNESS}"))
            yield f"{cluster.address}&shared"
        finally:
            cluster.close()


if __name__ == "__main__":
    _, *asked = sys.argv
    if asked[:1] == ["one-empty"]:
        empty(*asked[1:])
    elif asked[:1] == ["one-suite"]:
        suite(*asked[1:])
    else:
        main(*asked)
