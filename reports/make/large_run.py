"""Seconds, seconds of CPU and peak memory of the commands that read a run folder of many cells.

python -m reports.make.large_run FOLDER [CELLS] makes the run FOLDER from one computed cell and
prints a line for each command. Each command runs in a process of its own. The rows have the sizes
of a robot with 21 joints and 81 parameters.
"""

import os
import random
import subprocess
import sys
import tempfile
import time
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from typing import Any

import sysid_bench
from sysid_bench.harness.plan import Plan, cells_of_suite
from sysid_bench.harness.stored_run import RunFolder
from sysid_bench.harness.suite.load_suite import load_suite
from sysid_bench.harness.suite.names import default_names

JOINTS, PARAMETERS = 21, 81
ESTIMATORS = ("ols", "wls", "ridge", "irls", "huber", "tukey", "tls", "rls", "ml", "kalman")
WRITERS = 4
COMMANDS = (("status",), ("table", "main"), ("report",))

SUITE = """
schema = 1
name = "large"
title = "Many cells"
seed = 1
[run]
repeats = {repeats}
[defaults]
excitation = {{ use = "fourier", harmonics = 2, period = "1 s", cycles = 1 }}
rate = "100 Hz"
noise = [{{ tau = "0.5 %" }}, {{ tau = "1 %" }}, {{ tau = "2 %" }}, {{ tau = "5 %" }}]
[[robot]]
use = ["ur5", "ur10"]
payloads = ["none"]
[[table]]
name = "main"
rows = ["robot", "payload"]
columns = ["noise", "estimator"]
cells = {{ metric = "torque_error", stat = "median", interval = "iqr" }}
best = "min-bold"
[[table]]
name = "repeats"
rows = ["robot", "payload"]
columns = ["estimator"]
metrics = ["rmse_test", "torque_error", "rank", "condition", "gap"]
"""


def make_run(folder: Path, cells: int, changed: Collection[str] = ()) -> RunFolder:
    """Return a run folder in which every planned cell has a row, without consolidated files;
    numbers of `changed` robots are others."""
    with tempfile.TemporaryDirectory() as name:
        few = _write_suite(Path(name), 1, ESTIMATORS[:1])
        done = sysid_bench.run(few, Path(name) / "run", jobs=1, limit=1)
        template = next(iter(RunFolder.open(done.folder.path).rows().rows.values()))
        suite_file = _write_suite(Path(name), max(1, cells // (8 * len(ESTIMATORS))), ESTIMATORS)
        names = default_names()
        suite = load_suite(suite_file, names)
        plan = cells_of_suite(suite, names)
    run = RunFolder.new(folder, suite, plan, {"python": "3"})
    writers = [run.new_writer(f"worker{number}") for number in range(WRITERS)]
    for number, row in enumerate(rows_of(plan, template, changed)):
        writers[number // len(ESTIMATORS) % WRITERS].write(row)
    for writer in writers:
        writer.close()
    return run


def rows_of(
    plan: Plan, template: Mapping[str, Any], changed: Collection[str] = ()
) -> Iterator[dict[str, Any]]:
    """Yield a row for each cell, with numbers that are drawn around those of a computed row."""
    for cell in plan.cells:
        other = cell.first_fields["robot"] in changed
        draw = random.Random(f"{cell.first_fields['id']}{other}")
        row = {key: _disturbed(value, draw) for key, value in template.items()} | cell.first_fields
        for field, count in (("joints", JOINTS), ("parameters_table", PARAMETERS)):
            entries = template[field]
            row[field] = [
                {key: _disturbed(value, draw) for key, value in entry.items()}
                | {"name": f"{entry['name']}{number // len(entries)}"}
                for number in range(count)
                for entry in [entries[number % len(entries)]]
            ]
        if draw.random() < 0.01:
            row |= {"status": "failed", "reason": "no convergence", "torque_error": None}
        yield row


def _disturbed(value: Any, draw: random.Random) -> Any:
    return value * (1 + 0.1 * draw.random()) if isinstance(value, float) else value


def _write_suite(folder: Path, repeats: int, estimators: tuple[str, ...]) -> Path:
    path = folder / f"large{repeats}.toml"
    entries = "".join(f'[[estimator]]\nuse = "{name}"\n' for name in estimators)
    path.write_text(SUITE.format(repeats=repeats) + entries)
    return path


def measured(code: str) -> tuple[float, float, float]:
    """Return the seconds, those of CPU, and the peak memory (MB) of a process that runs a code."""
    start = time.perf_counter()
    process = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.DEVNULL)
    _, status, usage = os.wait4(process.pid, 0)
    if status:
        raise RuntimeError(f"{code} ended with {status}.")
    cpu = usage.ru_utime + usage.ru_stime
    return time.perf_counter() - start, cpu, usage.ru_maxrss / 1024


def main(folder: str, cells: str = "50000") -> None:
    """Make the run where it is absent, then measure."""
    here = "import reports.make.large_run as l; "
    verbs = "from sysid_bench.commands.main import main; "
    steps = {verb: f"{verbs}main({[verb, folder, *rest]!r})" for verb, *rest in COMMANDS}
    frames = {"frames": f"{here}l.RunFolder(l.Path({folder!r})).write_frames()"}
    if not (Path(folder) / "plan.jsonl").is_file():
        made = {"rows": f"{here}l.make_run(l.Path({folder!r}), {int(cells)})"}
        steps = {**made, **frames, **steps}
    elif not (Path(folder) / "consolidated.json").is_file():
        steps = {**frames, **steps}
    for name, code in steps.items():
        seconds, cpu, memory = measured(code)
        print(f"{name:<8} {seconds:7.1f} s {cpu:7.1f} s CPU {memory:7.0f} MB", flush=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
