"""A cell executed again, with everything that a picture of it needs."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from sysid_bench.harness.experiment.prepare import Prepared, prepare
from sysid_bench.harness.experiment.robots import Subject, subject
from sysid_bench.harness.experiment.spec import ExperimentSpec
from sysid_bench.identification.compressed import compress
from sysid_bench.identification.identify import identify
from sysid_bench.models.appearance import poses, shapes_of
from sysid_bench.naming import build
from sysid_bench.types import Array, Estimate, Evidence, Row


def evidence(argument: Mapping[str, Any], row: Row) -> Evidence:
    """The evidence of the first estimator of `argument` (see harness/argument.py), beside its row.

    Raises the error that the cell itself ended with, where it never came to an estimate.
    """
    spec = ExperimentSpec.from_json(argument["experiment"])
    places = argument["robots_dir"], argument["folder"]
    robot = subject(spec.robot, spec.payload, *places, spec.free_base)
    ready = prepare(spec, robot)
    (estimator, *_) = argument["estimators"]
    settings = {key: value for key, value in estimator.items() if key not in ("cell", "label")}
    try:
        estimate = identify(build("estimator", settings), ready.problem, ready.experiment)
    except Exception as error:  # a stranger's method: the picture shows the data without it
        estimate = Estimate(status="failed", reason=f"{type(error).__name__}: {error}")
    return _evidence(row, ready, robot, estimate)


def _evidence(row: Row, ready: Prepared, robot: Subject, estimate: Estimate) -> Evidence:
    recording, model = ready.experiment.recording, ready.robot
    motion = recording.motion
    positions, quaternions = poses(model, motion.q)
    r = ready.problem.base.rank
    places = [model.torque_rows.index(row) for row in ready.problem.rows]
    tree_rows = [model.rows.index(row) for row in ready.problem.rows]
    parents = [int(model.mj.body_parentid[b]) - 1 for b in range(1, model.mj.nbody)]
    return Evidence(
        row=row,
        motion=motion,
        measured=recording.tau[:, places],
        predicted=_predicted(ready, estimate),
        rows=ready.problem.rows,
        singular_values=np.linalg.svd(compress(ready.problem)[:r, :r], compute_uv=False),
        gap_map=robot.check.gap_map[tree_rows],
        gap_columns=robot.check.columns,
        estimate=estimate,
        base=ready.problem.base,
        bodies=model.body_names,
        parents=tuple(parents),
        positions=positions,
        quaternions=quaternions,
        shapes=shapes_of(model),
    )


def _predicted(ready: Prepared, estimate: Estimate) -> Array | None:
    """Torque (N, rows) of the estimate along the measured motion, with what the task knows."""
    if estimate.status != "ok" or estimate.beta is None:
        return None
    blocks = ready.experiment.regress(ready.experiment.recording.motion)
    return np.concatenate([block @ estimate.beta for block in blocks]) + ready.known
