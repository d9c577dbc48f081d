"""Columns of bodies in the row of one joint, and the torque that effects leave to bodies."""

from collections.abc import Mapping, Sequence

import numpy as np

from sysid_bench.experiments.recorded.problem import LogProblemBuilder
from sysid_bench.models.robot import SUFFIX
from sysid_bench.twins.effect_columns import BASE, JointEffects, effect_values
from sysid_bench.twins.effect_selection import JointFit
from sysid_bench.twins.joint_signals import FRICTION, JointSignals
from sysid_bench.types import Array, Recording


def body_columns(
    builder: LogProblemBuilder, recording: Recording, signals: JointSignals
) -> list[Array]:
    """Return the filtered base regressor (N, k) of bodies and armature in the row of each measured
    joint, without columns of zeros."""
    own = tuple(f".{SUFFIX[term]}" for term in FRICTION)
    names = [name for name in builder.unknowns.robot_parameters if not name.endswith(own)]
    regression, _ = builder.rigid_regression(builder.unknowns.robot, names)
    blocks = list(regression.blocks(recording.motion))
    found = []
    for row in builder.unknowns.rows:
        k = regression.rows.index(row)
        columns = np.concatenate([block.row(k).T for block in blocks])
        moved = columns[:, np.abs(columns).max(axis=0) > 0.0]
        found.append(signals.smooth(moved))
    return found


def torque_of_bodies(fits: Mapping[str, JointFit], signals: JointSignals) -> Array:
    """Return the measured torque (N, n) without what the kept effects add to viscous friction,
    sign(v) and offset, and in time."""
    left = [_left(fits[name], signals, j) for j, name in enumerate(signals.joints)]
    return np.column_stack(left)


def _left(fit: JointFit, signals: JointSignals, j: int) -> Array:
    plain, names = JointEffects(), fit.effects.columns
    added = _torque(fit, fit.effects, names, signals, j) - _torque(fit, plain, BASE, signals, j)
    tau = np.interp(signals.t + fit.effects.delay, signals.t, signals.tau[:, j])
    return np.asarray(tau - added)


def _torque(
    fit: JointFit, effects: JointEffects, names: Sequence[str], signals: JointSignals, j: int
) -> Array:
    """Torque (N,) of some columns of a fit."""
    parts = [fit.beside[name] * effect_values(signals, j, name, effects) for name in names]
    return np.asarray(sum(parts))
