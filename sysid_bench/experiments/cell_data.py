"""A cell executed again, with everything that a picture of it needs."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from sysid_bench.errors import UnsupportedError
from sysid_bench.experiments.robot_cache import LoadedRobot, cached_robot
from sysid_bench.experiments.simulated.online_curves import online_curves
from sysid_bench.experiments.simulated.prepare import Prepared, prepare
from sysid_bench.experiments.simulated.problem import measured_signals
from sysid_bench.experiments.spec import ExperimentSpec
from sysid_bench.identification.identify import identify
from sysid_bench.identification.linear.normal_qr import stacked_factor
from sysid_bench.models.random.random_states import random_states
from sysid_bench.models.visuals import body_poses, shapes_of
from sysid_bench.naming import build
from sysid_bench.regressors.pinocchio_wrench import pinocchio_wrench_regressor
from sysid_bench.regressors.wrench import sub_tree
from sysid_bench.types import Array, CellData, Estimate, Row


def cell_data(argument: Mapping[str, Any], row: Row) -> CellData:
    """The evidence of the first estimator of `argument` (see harness/job.py), beside its row.

    Raises the error that the cell itself ended with, where it never came to an estimate.
    """
    spec = ExperimentSpec.from_json(argument["experiment"])
    if spec.log is not None:
        raise UnsupportedError(
            "A cell of real recordings has no simulation to show; [[paper]] show = 'torques' draws "
            "what was measured and predicted."
        )
    places = argument["robots_dir"], argument["folder"]
    robot = cached_robot(spec.robot, spec.payload, *places, spec.free_base)
    ready = prepare(spec, robot)
    (estimator, *_) = argument["estimators"]
    settings = {key: value for key, value in estimator.items() if key not in ("cell", "label")}
    try:
        estimate = identify(build("estimator", settings), ready.problem, ready.experiment)
    except Exception as error:  # a stranger's method: the picture shows the data without it
        estimate = Estimate(status="failed", reason=f"{type(error).__name__}: {error}")
    return _evidence(row, ready, robot, estimate)


def _evidence(row: Row, ready: Prepared, robot: LoadedRobot, estimate: Estimate) -> CellData:
    recording, model = ready.experiment.recording, ready.robot
    motion = recording.motion
    positions, quaternions = body_poses(model, motion.q)
    r = ready.problem.base.rank
    names = (*model.torque_rows, *recording.wrench_rows)
    places = [names.index(row) for row in ready.problem.rows]
    parents = [int(model.mj.body_parentid[b]) - 1 for b in range(1, model.mj.nbody)]
    return CellData(
        row=row,
        motion=motion,
        measured=measured_signals(recording)[:, places],
        predicted=_predicted(ready, estimate),
        rows=ready.problem.rows,
        singular_values=np.linalg.svd(stacked_factor(ready.problem)[:r, :r], compute_uv=False),
        **_gap(robot, ready),
        estimate=estimate,
        base=ready.problem.base,
        bodies=model.body_names,
        parents=tuple(parents),
        positions=positions,
        quaternions=quaternions,
        shapes=shapes_of(model),
        curves=online_curves(ready),
    )


def _gap(robot: LoadedRobot, ready: Prepared) -> dict[str, Any]:
    """Where our regressor and Pinocchio's differ, on the rows that are measured."""
    rows, check = ready.problem.rows, robot.check
    if not ready.task.cuts:
        places = [ready.robot.rows.index(row) for row in rows]
        return {"gap_map": check.gap_map[places], "gap_columns": check.columns}
    cut = ready.task.cuts[0]
    motion = random_states(ready.robot, 5, np.random.default_rng(0))
    base = ready.robot.body_names[cut.body]
    ours = sub_tree(ready.robot, cut, motion).base_wrench(base)
    theirs, _ = pinocchio_wrench_regressor(ready.robot, cut, motion, base)
    return {"gap_map": np.abs(ours - theirs.Y).max(axis=0), "gap_columns": theirs.columns}


def _predicted(ready: Prepared, estimate: Estimate) -> Array | None:
    """Torque (N, rows) of the estimate along the measured motion, with what the task knows."""
    if estimate.status != "ok" or estimate.beta is None:
        return None
    blocks = ready.experiment.regress(ready.experiment.recording.motion)
    return np.concatenate([block @ estimate.beta for block in blocks]) + ready.known
