"""Cells of a run repeated on data whose last bits differ."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Final

from sysid_bench.experiments.cell_data import SIZE
from sysid_bench.harness.cell import Cell
from sysid_bench.harness.run import job_of
from sysid_bench.harness.stored_run import RunFolder
from sysid_bench.harness.work.worker_call import CallWorker, WorkerError
from sysid_bench.types import Row
from sysid_bench.units import quantity

SAME: Final = "same"
_REPEAT: Final = "sysid_bench.experiments.cell_data:repeat_cells"
_GROWTH: Final = 1e3
"""Growth of the changes beyond the condition number that an answer may show."""
_LEAST: Final = 1e-9
"""Change of the torque error, relative to the torque, that says nothing."""
_TOLERANCE: Final = 1e-6
"""Change relative to the torque error itself within which solvers stop."""
_ENDS: Final = ("status", "converged", "stop")


def repeat_difference(run: RunFolder, ids: Sequence[str], repeats: int) -> dict[str, str]:
    """Return the effect of the data's last bits on the answers of cells, by id: "same", or the
    different ends and the range of the torque error. Each cell is executed again, on its data and
    on `repeats` copies with other last bits, in a worker process with the limits of the suite."""
    wanted, found = set(ids), dict[str, str]()
    groups = dict[str, list[Cell]]()
    for cell in run.plan.cells:
        if cell.id in wanted:
            groups.setdefault(cell.experiment, []).append(cell)
    limits = run.suite.run
    timeout = quantity(limits.timeout, "s") * (repeats + 1)
    for group in groups.values():
        with CallWorker(timeout * len(group), quantity(limits.memory, "B")) as worker:
            found |= _group_texts(run, group, repeats, worker)
    return found


def _group_texts(
    run: RunFolder, group: Sequence[Cell], repeats: int, worker: CallWorker
) -> dict[str, str]:
    """Texts of the cells of one experiment."""
    job = job_of(group, run.suite, run.suite.robots_folder)
    try:
        answers = worker.call(_REPEAT, {"job": job, "repeats": repeats}, "last bits")
    except WorkerError as error:
        return {cell.id: str(error) for cell in group}
    return {cell: difference_text(rows) for cell, rows in answers.items()}


def difference_text(answers: Sequence[Row]) -> str:
    """Return the differences between answers to one problem beyond the condition of the data times
    the size of the changes, and beyond the tolerance of solvers; "same" without any."""
    parts = [
        f"{name} {' or '.join(map(str, values))}"
        for name in _ENDS
        if len(values := _different(answers, name)) > 1
    ]
    errors = [row["torque_error"] for row in answers if row.get("torque_error") is not None]
    limit = max(_explained(answers), _TOLERANCE * max(errors, default=0.0))
    if errors and max(errors) - min(errors) > limit:
        parts.append(f"torque_error {min(errors):.7g} to {max(errors):.7g}")
    counts = _different(answers, "iterations")
    if parts and len(counts) > 1:
        parts.append(f"iterations {' or '.join(map(str, counts))}")
    return "; ".join(parts) or SAME


def _different(answers: Iterable[Mapping[str, Any]], name: str) -> list[Any]:
    return list(dict.fromkeys(row.get(name) for row in answers))


def _explained(answers: Sequence[Row]) -> float:
    condition = max((row.get("condition") or 1.0 for row in answers), default=1.0)
    return max(_LEAST, _GROWTH * condition * SIZE)
