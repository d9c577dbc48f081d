"""Data of a suite's [[paper]] entries, stored when a cell runs: reports need no robot or log.

A cell's folder `paper/` holds NAME.json (model, base parameters) or NAME.npz (torques, curves).
"""

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np

from sysid_bench.errors import UsageError, reason_of
from sysid_bench.experiments.base_table import base_table
from sysid_bench.experiments.experiment_data import ExperimentData
from sysid_bench.experiments.processed_rows import sampled_motion
from sysid_bench.experiments.recorded.source import RecordedSource, predict_log
from sysid_bench.experiments.simulated.wrench_score import subtree_parameters
from sysid_bench.identifiability.base_expressions import base_expressions
from sysid_bench.identification.estimators.recursive import ParameterCurves, RecursiveEstimator
from sysid_bench.identification.linear.least_squares import dense_rows, residual_norm, spread
from sysid_bench.models.dh_table import paper_table
from sysid_bench.models.load import load_robot
from sysid_bench.models.manifest import Manifest, find_manifest
from sysid_bench.models.robot import RobotModel
from sysid_bench.models.sensor import SensorSubtree
from sysid_bench.regressors.wrench import subtree_regressor
from sysid_bench.types import Array, Curve, Estimate, Problem, Trajectory

POINTS: Final = 1000
"""Samples of a curve at most, about: more cannot be seen in print."""


def motion_curves(robot: RobotModel, motion: Trajectory) -> tuple[Curve, ...]:
    """Return position and velocity (rad, m, /s) of each hinge and slide that has coordinates of its
    own, with their limits where these are stated: Fig. 5 of Fontanelli et al. (2017)."""
    thin, limits = sampled_motion(motion, max(len(motion) // POINTS, 1)), robot.limits
    curves = []
    for joint in robot.joints:
        k = joint.vadr
        if joint.kind not in ("hinge", "slide") or k not in robot.torque_dofs:
            continue
        unit = "rad" if joint.kind == "hinge" else "m"
        for x, low, high, of in (
            (thin.q[:, joint.qadr], limits.q_low[k], limits.q_high[k], unit),
            (thin.v[:, k], -limits.v[k], limits.v[k], f"{unit}/s"),
        ):
            stated = (float(low), float(high)) if np.isfinite(high - low) else None
            curves.append(Curve(joint.name, thin.t, {"": x}, of, stated))
    return tuple(curves)


HISTORY: Final = 400
"""Points of a curve, about."""


def estimate_curves(prepared: ExperimentData[Any]) -> tuple[Curve, ...]:
    """The curves of an experiment with the task `wrench` and a prior; of any other, none: torques
    and parameters over time, Figures 3 and 4 of Traversaro et al. (2015).

    Beside the estimate stand the true parameters of a simulation, or the measured torque of the
    joints where a recording has it.
    """
    problem, source = prepared.problem, prepared.source
    if problem.prior is None or problem.samples == 0:
        return ()
    known: dict[str, Array] = {}
    measured: dict[str, Array] = {}
    if isinstance(source, RecordedSource):
        sub_tree, log = source.builder.unknowns.sub_tree, source.training[0]
        if sub_tree is None:
            return ()
        problem = problem.motions[0] if problem.motions else problem
        cut, track = sub_tree.cuts[0], _track_of(problem)
        motion, at = log.recording.motion, track.indices * log.rows.step
        if log.log.description.has_torque:
            names, tau = log.robot.torque_rows, log.recording.tau[at]
            measured = {row: tau[:, names.index(row)] for row in log.log.joints}
        true = track.beta[-1]  # parameters converge to the last estimate, as no truth is known
    else:
        if not source.task.definition.identifies_sub_tree:
            return ()
        cut, track = source.task.cuts[0], _track_of(problem)
        motion, at = prepared.experiment.recording.motion, track.indices
        known = {"true": source.truth.theta}
        true = problem.base.K @ source.truth.theta
    kept = Trajectory(motion.t[at], motion.q[at], motion.v[at], motion.a[at])
    return (
        *_torques(prepared, cut, track, kept, known, measured),
        _convergence(problem, track, true, kept.t),
    )


def _track_of(problem: Problem) -> ParameterCurves:
    """Recursive least squares over the samples of a problem, from its prior."""
    assert problem.prior is not None
    W, f = dense_rows(problem)
    K, r, step = problem.base.K, problem.base.rank, max(len(f) // HISTORY, 1)
    # Noise (m,) of each row: RMS residual of the best fit. Exact data leave rounding errors, whose
    # size is not a weight.
    R = np.vstack([np.zeros((1, r + 1)), *(spread(factor, r) for factor in problem.factors)])
    beta = np.linalg.lstsq(R[:, :-1], R[:, -1], rcond=None)[0]
    size = max(max(float(np.linalg.norm(factor.R[:, -1])) for factor in problem.factors), 1e-12)
    noise = np.maximum(residual_norm(problem, beta), 1e-6 * size) / np.sqrt(problem.samples)
    # beta = K theta with independent theta: the covariance is K diag(std^2) K'.
    covariance = (K * problem.prior.std**2) @ K.T
    return RecursiveEstimator(every=step).run(W, f, noise, K @ problem.prior.theta, covariance)


def _torques(
    prepared: ExperimentData[Any],
    cut: SensorSubtree,
    track: ParameterCurves,
    motion: Trajectory,
    known: Mapping[str, Array],
    measured: Mapping[str, Array],
) -> Iterator[Curve]:
    """Torques of the joints distal to the sensor by parameters `known` (p,), the prior (CAD), and
    the current estimate, beside those `measured` (K,) by row."""
    tree = subtree_regressor(prepared.robot, cut, motion)
    problem = prepared.problem
    assert problem.prior is not None
    constant = {**known, "CAD": problem.prior.theta}
    sets = {name: np.tile(theta, (len(motion), 1)) for name, theta in constant.items()}
    sets["on-line"] = np.array([problem.base.embed(beta) for beta in track.beta])
    torques = {
        name: np.einsum("nkp,np->nk", tree.Y_c, subtree_parameters(theta, problem, tree.columns))
        for name, theta in sets.items()
    }
    for i, row in enumerate(tree.rows):
        given = {"measured": measured[row]} if row in measured else {}
        found = {name: tau[:, i] for name, tau in torques.items()}
        yield Curve(f"torque of {row}", motion.t, {**given, **found})


def _convergence(problem: Problem, track: ParameterCurves, true: Array, t: Array) -> Curve:
    """Norms of the error and of its declared deviation, relative to that of the parameters."""
    assert problem.prior is not None
    size = float(np.linalg.norm(true)) or 1.0
    cad = np.linalg.norm(problem.base.K @ problem.prior.theta - true) / size
    series = {
        "CAD": np.full(len(t), cad),
        "on-line": np.linalg.norm(track.beta - true, axis=1) / size,
        "declared deviation": np.linalg.norm(track.std, axis=1) / size,
    }
    return Curve("relative parameter error", t, series)


FOLDER: Final = "paper"


def write_paper_data(
    argument: Mapping[str, Any], cell: str, estimate: Estimate, prepared: ExperimentData[Any]
) -> None:
    """Write the files of `argument["papers"][cell]` below `argument["artifacts"]` (see
    `job_of` in harness/run.py), where the cell is ok.

    Never raises for an entry that cannot be had: its file holds the reason.
    """
    entries = argument.get("papers", {}).get(cell, ())
    if estimate.status != "ok" or not entries or "artifacts" not in argument:
        return
    folder = Path(argument["artifacts"]) / cell / FOLDER
    folder.mkdir(parents=True, exist_ok=True)
    for entry in entries:
        try:
            _store(argument, entry, folder, estimate, prepared)
        except Exception as error:
            _write_json(folder, entry["name"], {"error": reason_of(error)})


def _store(
    argument: Mapping[str, Any],
    entry: Mapping[str, Any],
    folder: Path,
    estimate: Estimate,
    prepared: ExperimentData[Any],
) -> None:
    name, shown = entry["name"], entry["show"]
    # The robot as the suite names it, without the joints that logs lock.
    places = [None if argument[k] is None else Path(argument[k]) for k in ("robots_dir", "folder")]
    manifest = find_manifest(argument["experiment"]["robot"], *places)
    if shown == "model":
        _write_json(folder, name, _model(manifest))
    elif shown in ("motion", "online"):
        np.savez_compressed(folder / f"{name}.npz", **_curve_arrays(shown, prepared))
    elif not isinstance(prepared.source, RecordedSource) or estimate.beta is None:
        raise UsageError(f"it shows {shown} of recordings; select a cell of a [[log]].")
    elif shown == "base-parameters":
        _write_json(folder, name, _base_parameters(manifest, prepared, estimate.beta))
    else:
        torque = predict_log(prepared, estimate.beta, entry["test"])
        np.savez_compressed(
            folder / f"{name}.npz",
            rows=torque.problem.rows,
            units=[kind.removeprefix("joint ") for kind in torque.problem.kinds],
            t=torque.t,
            measured=torque.measured,
            predicted=torque.predicted,
        )


def _curve_arrays(shown: str, prepared: ExperimentData[Any]) -> dict[str, Any]:
    """Names, units and limits of the curves of the training motion or of the on-line estimate, with
    t0 (K,), series0 (names), values0 (S, K) and so on; raises UsageError where there are none."""
    if shown == "motion":
        source, recording = prepared.source, prepared.experiment.recording
        if isinstance(source, RecordedSource):
            recording = source.training[0].recording
        curves = motion_curves(prepared.robot, recording.motion)
    else:
        curves = estimate_curves(prepared)
    if not curves:
        raise UsageError(
            "there is no joint whose motion can be drawn."
            if shown == "motion"
            else "it shows an on-line estimate; select a cell of the task wrench that has a prior."
        )
    arrays: dict[str, Any] = {
        "curves": [curve.name for curve in curves],
        "units": [curve.unit for curve in curves],
        "limits": [curve.limits or (np.nan, np.nan) for curve in curves],
    }
    for k, curve in enumerate(curves):
        arrays |= {
            f"t{k}": curve.t,
            f"series{k}": list(curve.series),
            f"values{k}": np.array(list(curve.series.values())),
        }
    return arrays


def _model(manifest: Manifest) -> dict[str, Any]:
    """The kinematic table where the robot has one, else its joints; limits in rad or m."""
    if manifest.dh is not None and manifest.manifest_file is not None:
        head, rows, lengths = paper_table(manifest.manifest_file.parent / manifest.dh.table)
        return {"robot": manifest.name, "head": head, "rows": rows, "lengths": dict(lengths)}
    robot = load_robot(manifest)
    low, high = robot.limits.q_low, robot.limits.q_high
    rows = tuple(
        (joint.name, joint.kind, f"{low[joint.vadr]:.4g}", f"{high[joint.vadr]:.4g}")
        for joint in robot.joints
    )
    head = ("joint", "kind", "from", "to")
    return {"robot": manifest.name, "head": head, "rows": rows, "lengths": {}}


def _base_parameters(
    manifest: Manifest, prepared: ExperimentData[RecordedSource], beta: Array
) -> dict[str, Any]:
    """The table of the robot's manifest with these values; `extra` are columns besides the robot's,
    as friction features have them."""
    base, unknowns = prepared.problem.base, prepared.source.builder.unknowns
    given = [
        {"terms": terms, "value": float(value)}
        for terms, value in zip(base_expressions(base), beta, strict=True)
    ]
    table = base_table(load_robot(manifest), unknowns.terms, None, {"base": given})
    named = zip(base.names, beta.tolist(), strict=True)
    return {
        "zero": table["zero"],
        "smallest_change": table["smallest_change"],
        "rows": [
            {k: row[k] for k in ("expression", "value", "impossible")} for row in table["rows"]
        ],
        "extra": {name: value for name, value in named if name in unknowns.extra},
    }


def _write_json(folder: Path, name: str, content: Mapping[str, Any]) -> None:
    (folder / f"{name}.json").write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
