"""Many empty cells, or the cells of a suite, on Dask workers of this machine and on local ones.

python -m reports.make.cluster_scale empty [CELLS] prints, for two workers of the executors
`local` and `dask`: seconds on the clock, CPU per cell of the client, its peak memory, and the rows
found. python -m reports.make.cluster_scale suite SUITE [SELECT] prints the seconds on the clock
of one and two workers of either executor, plan and consolidation included, on an idle machine, and
the CPU time of all processes. Workers of Dask have joined before the clock starts.
python -m reports.make.cluster_scale asleep RUN prints them for the suite of a stored run, whose
experiments sleep for the CPU time that they took there: also on a busy machine.
"""

import contextlib
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Iterator, Mapping
from functools import cache
from pathlib import Path
from typing import Any

from sysid_bench.experiments.job_channel import JobChannel
from sysid_bench.harness.run import run
from sysid_bench.harness.stored_run import RunFolder
from sysid_bench.harness.suite.load_suite import load_suite, parse_suite
from sysid_bench.harness.suite.model import Suite
from tests.cluster.cluster_world import ROOT, Cluster

HARNESS = ROOT / "tests" / "harness"
ESTIMATORS = 100
"""Per experiment, so that a batch has the 2000 cells that it may have."""


def main(kind: str = "empty", *words: str) -> None:
    """Print the table of a kind; each run has a process of its own, whose memory is measured."""
    runs = [("local", "2"), ("dask", "2")]
    if kind != "empty":
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
    _print_times(executor, int(workers), load_suite(Path(file)), select=select)


def asleep(executor: str, workers: str, folder: str) -> None:
    """Run the suite of a stored run without its work."""
    os.environ[_RUN] = folder
    stored = RunFolder.open(Path(folder))
    _print_times(executor, int(workers), stored.suite, call=f"{__spec__.name}:sleep")


def sleep(argument: Mapping[str, Any], channel: JobChannel) -> None:
    """Write the rows of an experiment; the first of all that differ in their repeat alone takes the
    longest of their times, and the shortest where this worker had one of them before."""
    labels = argument["labels"]
    kept = _without_repeat(labels)
    times = _times(os.environ[_RUN])[kept]
    time.sleep(min(times) if kept in _had else max(times))
    _had.add(kept)
    for estimator in argument["estimators"]:
        if (cell := estimator["cell"]) in channel.cells:
            channel.start_cell(cell)
            row = {"id": cell, "estimator": estimator["label"], "status": "ok", "reason": ""}
            channel.write({**labels, **row, "fingerprint": argument["fingerprints"][cell]})


_RUN = "SYSID_BENCH_RUN_ASLEEP"
_had: set[tuple[Any, ...]] = set()


@cache
def _times(folder: str) -> Mapping[tuple[Any, ...], list[float]]:
    found = defaultdict[tuple[Any, ...], list[float]](list)
    for row in RunFolder.open(Path(folder)).rows().rows.values():
        found[_without_repeat(row)].append(row["seconds_experiment_cpu"])
    return found


def _without_repeat(row: Mapping[str, Any]) -> tuple[Any, ...]:
    return tuple(row[key] for key in ("robot", "payload", "task", "noise", "signals"))


def _print_times(executor: str, workers: int, asked: Suite, **settings: Any) -> None:
    before = _cpu_seconds()
    heard = list[float]()

    def hear(kind: str, data: Mapping[str, Any]) -> None:
        if kind == "row":
            heard.append(time.perf_counter())

    with _address(executor, workers) as address, tempfile.TemporaryDirectory() as name:
        start = time.perf_counter()
        run(asked, Path(name) / "run", jobs=workers, executor=address, on_event=hear, **settings)
        seconds = time.perf_counter() - start
    print(
        f"{executor:5s} {workers} workers: {seconds:7.1f} s, of these {heard[-1] - heard[0]:.1f} s "
        f"from the first row to the last; {len(heard)} rows, "
        f"{_cpu_seconds() - before:.1f} s of CPU",
        flush=True,
    )


def _cpu_seconds() -> float:
    """CPU time of this process and of its children that have ended."""
    return sum(os.times()[:4])


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
            cluster.wait_for_workers(workers)
            yield f"{cluster.address}&shared"
        finally:
            cluster.close()


if __name__ == "__main__":
    _, *asked = sys.argv
    if asked[:1] == ["one-empty"]:
        empty(*asked[1:])
    elif asked[:1] == ["one-suite"]:
        suite(*asked[1:])
    elif asked[:1] == ["one-asleep"]:
        asleep(*asked[1:])
    else:
        main(*asked)
