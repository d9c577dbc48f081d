"""Torque that the kept effects of a twin leave to its bodies."""

from collections.abc import Mapping, Sequence

import numpy as np

from sysid_bench.apps.twins.effect_columns import BASE, JointEffects, effect_values
from sysid_bench.apps.twins.effect_selection import JointFit
from sysid_bench.apps.twins.joint_signals import JointSignals
from sysid_bench.types import Array


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
    parts = [fit.values[name] * effect_values(signals, j, name, effects) for name in names]
    return np.asarray(sum(parts))
