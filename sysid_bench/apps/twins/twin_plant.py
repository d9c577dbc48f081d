"""Plant of a twin: fitted effects as entries of a plant file, and the joints' own friction."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np

from sysid_bench.apps.twins.coloured_noise import ColouredNoise
from sysid_bench.apps.twins.effect_columns import BASE, SHARPNESS, STEP_WIDTH
from sysid_bench.apps.twins.effect_selection import JointFit
from sysid_bench.models.load import load_robot
from sysid_bench.models.manifest import JointTerms
from sysid_bench.models.robot import RobotModel
from sysid_bench.simulation.effects.friction import rate_limit
from sysid_bench.simulation.motor_load import gravity_rms
from sysid_bench.types import Array

OF_GRAVITY: Final = ("stribeck", "low-harmonics")
"""Begin of the groups whose size is a share of the torque of gravity."""


@dataclass(frozen=True, eq=False)
class _Sizes:
    """Fits by the row of their joint, and the scales that sizes refer to, (nv,) each."""

    robot: RobotModel
    fits: Mapping[str, JointFit]
    force: Array
    speed: Array

    def value(self, name: str, column: str) -> float:
        fit = self.fits.get(name)
        return 0.0 if fit is None else fit.values.get(column, 0.0)

    def shape(self, name: str, what: str, otherwise: float) -> float:
        fit = self.fits.get(name)
        return otherwise if fit is None else float(getattr(fit.effects, what))

    def of(self, rows: Sequence[str], column: str) -> Array:
        return np.array([self.value(name, column) for name in rows])

    def share(self, torque: Array) -> Array:
        """Return torques (nv,) as shares of that of gravity, 0 where there is none."""
        zero = np.zeros_like(torque)
        return np.asarray(np.divide(torque, self.force, out=zero, where=self.force > 0))

    def shapes(self, rows: Sequence[str], what: str, otherwise: float) -> list[float]:
        return [self.shape(name, what, otherwise) for name in rows]


def with_friction(robot: RobotModel, fits: Mapping[str, JointFit]) -> RobotModel:
    """Return the robot with the viscous and Coulomb friction and the offset of each fit."""
    joints = dict(robot.manifest.joints)
    for name, fit in fits.items():
        own = {term: fit.values[term] for term in BASE}
        joints[name] = joints.get(name, JointTerms()).model_copy(update=own)
    return load_robot(replace(robot.manifest, joints=joints), robot.payload)


def plant_keys(
    robot: RobotModel, fits: Mapping[str, JointFit], noise: ColouredNoise
) -> dict[str, Any]:
    """Return the keys of the plant file of a robot that has the friction of the fits."""
    gravity = gravity_rms(robot, robot.mj)
    force = np.maximum(gravity, 1e-3 * gravity.max())
    sizes = _Sizes(robot, fits, force, rate_limit(robot))
    effects: list[Any] = [entry for make in _EFFECTS for entry in make(sizes)]
    sensors = [entry for make in _SENSORS for entry in make(sizes)]
    return {
        "simulation": {"use": "inverse"},
        "effects": effects or ["matched"],
        "sensors": [*noise.entries(), *sensors],
    }


def _percent(shares: Array) -> list[float]:
    """Shares as plant files write them without a unit."""
    return [100.0 * share for share in shares.tolist()]


def _play(sizes: _Sizes) -> list[dict[str, Any]]:
    widths = sizes.shapes(sizes.robot.rows, "width", STEP_WIDTH)
    return [{"use": "play", "width": widths}] if max(widths) > STEP_WIDTH else []


def _load_friction(sizes: _Sizes) -> list[dict[str, Any]]:
    load = sizes.of(sizes.robot.rows, "load")
    widths = sizes.shapes(sizes.robot.rows, "width", STEP_WIDTH)
    entry = {"use": "load-friction", "coulomb": _percent(load), "width": widths}
    return [entry] if load.any() else []


def _stribeck(sizes: _Sizes) -> list[dict[str, Any]]:
    share = sizes.share(sizes.of(sizes.robot.rows, "stribeck"))
    vs = np.array(sizes.shapes(sizes.robot.rows, "vs", 1.0))
    v0 = (vs / SHARPNESS).tolist()
    entry = {"use": "stribeck", "share": _percent(share), "vs": vs.tolist(), "v0": v0}
    return [entry] if share.any() else []


def _curved(sizes: _Sizes) -> list[dict[str, Any]]:
    rows = sizes.robot.rows
    viscous, curve = sizes.of(rows, "viscous"), sizes.of(rows, "curved")
    share = curve * sizes.speed / np.where(viscous > 0, viscous, np.inf)
    return [{"use": "curved-friction", "curvature": _percent(share)}] if share.any() else []


def _harmonics(sizes: _Sizes) -> list[dict[str, Any]]:
    orders = enumerate(("first", "second", "third"), start=1)
    entries = [_harmonic(sizes, order, word) for order, word in orders]
    return [entry for entry in entries if any(entry["phase"])]


def _harmonic(sizes: _Sizes, order: int, word: str) -> dict[str, Any]:
    rows = sizes.robot.rows
    A, B = sizes.of(rows, f"sin {order}"), sizes.of(rows, f"cos {order}")
    phase = np.arctan2(B, A) / order
    none = dict.fromkeys(("first", "second", "third"), 0.0)
    share = _percent(sizes.share(np.hypot(A, B)))
    return {"use": "low-harmonics", **none, word: share, "phase": phase.tolist()}


def _drift(sizes: _Sizes) -> list[dict[str, Any]]:
    slope = sizes.of(sizes.robot.torque_rows, "time")
    return [{"use": "torque-drift", "slope": slope.tolist()}] if slope.any() else []


def _delay(sizes: _Sizes) -> list[dict[str, Any]]:
    late = sizes.shapes(sizes.robot.torque_rows, "delay", 0.0)
    return [{"use": "delay", "tau": late}] if any(late) else []


_EFFECTS: Final[tuple[Callable[[_Sizes], list[dict[str, Any]]], ...]] = (
    *(_play, _load_friction, _stribeck, _curved, _harmonics),
)
_SENSORS: Final[tuple[Callable[[_Sizes], list[dict[str, Any]]], ...]] = (_drift, _delay)
