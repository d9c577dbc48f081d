"""Effects of a joint, selected by cross-validation over blocks of time.

The torque of each effect is a column as the plug-in of its name has it, per unit of its size. A
joint's friction has a direction s, sign(v) with the play of a `width` at each reversal, which all
its columns share. Each group of columns is kept or left out as a whole."""

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from operator import attrgetter
from typing import Any, Final

import numpy as np

from sysid_bench.experiments.recorded.process_log import LogProcessing, ProcessedLog
from sysid_bench.models.robot import RobotModel
from sysid_bench.signals.filter import Filter
from sysid_bench.simulation.effects.friction import play_position
from sysid_bench.simulation.inverse import Inverse, joint_positions, rigid_torque
from sysid_bench.simulation.plant import Plant, plant_of
from sysid_bench.types import Array, Recording

BASE: Final = ("viscous", "coulomb", "offset")
"""Columns of every joint: its terms that are fitted again beside the effects."""


@dataclass(frozen=True, eq=False)
class JointSignals:
    """Motion and torque of n joints at N samples, filtered as for a test: positions `q` and rates
    `v`, the torque on the links `load`, the torque `rest` of all but the joints' own BASE, and
    the measured torque `tau`, (N, n) each. `filter` is that of the torque."""

    joints: tuple[str, ...]
    t: Array
    q: Array
    v: Array
    load: Array
    rest: Array
    tau: Array
    rate: float  # Hz
    filter: Filter

    def smooth(self, x: Array) -> Array:
        """Return columns x (N, k) through the filter of the torque."""
        return self.filter.smooth(x, self.rate)


def processed_recording(log: ProcessedLog, preprocessing: LogProcessing) -> Recording:
    """Return a recording with the motion and torque that a test on it would have."""
    found = preprocessing.signals(log.log.recording, log.robot.joints, training=False).recording
    motion = log.robot.completed(found.motion)
    return replace(found, q=motion.q, v=motion.v, a=motion.a)


def joint_signals(robot: RobotModel, recording: Recording, filter: Filter) -> JointSignals:
    """Return the signals of a processed recording along which a robot with these inertias moved."""
    dofs, motion, full = robot.torque_dofs, recording.motion, plant_of(robot)
    none = {name: getattr(robot.joint_terms, name).copy() for name in BASE}
    # BASE is fitted again beside the effects, so that `rest` must not contain it; joints without a
    # measured torque keep theirs.
    for values in none.values():
        values[dofs] = 0.0
    plant = Plant(robot, replace(full.terms, **none), full.laws)
    oracle, _ = Inverse().run(plant, motion, np.zeros((len(motion), len(dofs))))
    # On the links: M a + bias without armature.
    rigid = rigid_torque(plant.contact_free_model, motion)
    load = rigid - robot.joint_terms.armature * motion.a
    return JointSignals(
        joints=robot.torque_rows,
        t=motion.t - motion.t[0],
        q=joint_positions(robot, motion)[:, dofs],
        v=motion.v[:, dofs],
        load=load[:, dofs],
        rest=oracle.tau,
        tau=recording.tau,
        rate=recording.rate,
        filter=filter,
    )


STEP_WIDTH: Final = 1e-6
"""rad, m: a transition so narrow that friction is sign(v)."""

WIDTHS: Final = (2e-4, 5e-4, 1e-3, 2e-3, 5e-3, 1e-2, 2e-2)
"""rad, m: transitions that are tried; 0.1 to 5 mrad in residuals of recorded arms."""

DELAYS: Final = (0.002, 0.005, 0.01, 0.015, 0.02, 0.03, 0.04, 0.06)
"""s: delays of the torque that are tried; recorded arms show up to 60 ms."""

SPEEDS: Final = (0.05, 0.15, 0.4)
"""Stribeck velocities that are tried, as shares of the RMS rate."""

SHARPNESS: Final = 20.0
"""Stribeck velocity over the width of its smooth sign."""

FOLDS: Final = 5
"""Blocks of time of each recording for cross-validation."""

GROUPS: Final[Mapping[str, tuple[str, ...]]] = {
    "load-friction": ("load",),
    "stribeck": ("stribeck",),
    "curved-friction": ("curved",),
    "low-harmonics 1": ("sin 1", "cos 1"),
    "low-harmonics 2": ("sin 2", "cos 2"),
    "low-harmonics 3": ("sin 3", "cos 3"),
    "torque-drift": ("time",),
}
"""Columns by the effect or sensor error that has them; of low harmonics by order."""

NOT_NEGATIVE: Final = ("viscous", "coulomb", "load", "stribeck")
"""Columns that dissipate: their coefficients are not negative."""

PRESLIDING, DELAY = "play", "delay"
"""Groups that change the other columns, and have none of their own."""

PERIODIC: Final = "low-harmonics"
"""Begin of the groups that hinges alone have."""


def group_names(turns: bool) -> tuple[str, ...]:
    """Return the groups of a hinge (`turns`) or a slide."""
    names = (PRESLIDING, DELAY, *GROUPS)
    return names if turns else tuple(n for n in names if not n.startswith(PERIODIC))


@dataclass(frozen=True)
class JointEffects:
    """Groups of columns of a joint, with the shapes of its friction: `width` (rad, m) of the
    transition, `delay` (s) of the torque, Stribeck velocity `vs` (rad/s, m/s)."""

    groups: tuple[str, ...] = ()
    width: float = STEP_WIDTH
    delay: float = 0.0
    vs: float = 1.0

    @property
    def columns(self) -> tuple[str, ...]:
        """Names of all columns, those of BASE first."""
        more = (name for group in self.groups for name in GROUPS.get(group, ()))
        return (*BASE, *more)

    def candidates(self, groups: Iterable[str], speed: float) -> Iterator["JointEffects"]:
        """Yield the effects with one further group in each of its shapes. `speed`: RMS rate of the
        joint."""
        for group in groups:
            if group in self.groups:
                continue
            added = replace(self, groups=(*self.groups, group))
            # Shapes are nonlinear: they are tried on a grid, so that every fit stays linear.
            if group == PRESLIDING:
                yield from (replace(added, width=width) for width in WIDTHS)
            elif group == DELAY:
                yield from (replace(added, delay=delay) for delay in DELAYS)
            elif group == "stribeck":
                yield from (replace(added, vs=share * speed) for share in SPEEDS)
            else:
                yield added


@dataclass(frozen=True, eq=False)
class JointColumns:
    """Filtered columns of one joint along some recordings, each computed once."""

    logs: tuple[JointSignals, ...]
    joint: int
    step: int  # every `step`-th sample is fitted
    _columns: dict[tuple[str, float], Array] = field(default_factory=dict)

    def matrix(self, effects: JointEffects) -> Array:
        """Return the columns (N, k) of these effects at the samples of the fit."""
        columns = []
        for name in effects.columns:
            # Only columns with a shape have it in their key: the others are filtered once for all
            # candidates.
            shape = effects.vs if name == "stribeck" else effects.width
            key = (name, shape if name in ("coulomb", "load", "stribeck") else 0.0)

            def values(one: JointSignals, name: str = name) -> Array:
                return one.smooth(effect_values(one, self.joint, name, effects)[:, None])

            columns.append(self._kept(key, values))
        return np.column_stack(columns)

    def torque_with_delay(self, delay: float) -> Array:
        """Return the torque (N,) that the columns have to explain, where it is late by `delay`."""

        def target(one: JointSignals) -> Array:
            # A torque that is late is read ahead of time.
            tau = np.interp(one.t + delay, one.t, one.tau[:, self.joint])
            # What is computed passes the filter that the measured torque has passed.
            return np.asarray(tau - one.smooth(one.rest[:, [self.joint]])[:, 0])

        return self._kept(("target", delay), target)

    @property
    def blocks(self) -> Array:
        """The block of time (N,) of each sample, those of every recording in turn."""
        # Blocks of time and not single samples: neighbours share their noise, and one left out
        # would be known from the next.
        counts = [len(range(0, len(one.t), self.step)) for one in self.logs]
        return np.concatenate([np.arange(n) * FOLDS // n for n in counts])

    @property
    def speed(self) -> float:
        """RMS rate of the joint (rad/s, m/s)."""
        v = np.concatenate([one.v[:, self.joint] for one in self.logs])
        return float(np.sqrt(np.mean(v**2)))

    def _kept(self, key: tuple[str, float], values: Callable[[JointSignals], Array]) -> Array:
        if key not in self._columns:
            parts = [values(one).reshape(-1)[:: self.step] for one in self.logs]
            self._columns[key] = np.concatenate(parts)
        return self._columns[key]


def effect_values(one: JointSignals, joint: int, name: str, effects: JointEffects) -> Array:
    """Return a column (N,) of effects of one joint, unfiltered."""
    q, v = one.q[:, joint], one.v[:, joint]
    word, _, order = name.partition(" ")
    if word in ("sin", "cos"):
        return np.asarray(getattr(np, word)(float(order) * q))
    if name in ("coulomb", "load"):
        # The play operator of the plant's own effect, over its width: unlike tanh(v / v0) it
        # depends on the way since the last reversal, not on the rate, as presliding does.
        if effects.width <= STEP_WIDTH:
            s = np.asarray(np.sign(v))
        else:
            place, w = np.empty_like(q), np.array(effects.width)
            p = np.asarray(q[0] - effects.width * np.sign(v[0]))
            for k, position in enumerate(q):
                p = play_position(p, position, w)
                place[k] = p
            s = np.asarray((q - place) / effects.width)
        return np.asarray(s if name == "coulomb" else np.abs(one.load[:, joint]) * s)
    if name == "stribeck":
        # A smooth sign of its own: the peak lies at rates where sign(v) is that of noise.
        peak = np.exp(-((v / effects.vs) ** 2))
        return np.asarray(peak * np.tanh(SHARPNESS * v / effects.vs))
    simple = {"viscous": v, "curved": np.abs(v) * v, "time": one.t}
    return np.asarray(simple.get(name, np.ones_like(v)))


SMALLEST: Final = 0.02
"""Share of the mean squared residual on left-out blocks that an effect has to remove."""

MAJORITY: Final = 4
"""Blocks in which it has to be smaller."""

TINY: Final = 1e-12
"""Ridge of the normal equations, relative to the scaled columns."""

LARGEST_LOAD: Final = 0.5
"""Load-dependent friction over the load: a gear with more locks itself."""

SMALLEST_CURVE, LARGEST_CURVE = -0.95, 5.0
"""Change of the viscous friction at the velocity limit over itself: below -1 friction would drive
the joint."""

LARGEST_PEAK: Final = 3.0
"""Stribeck peak over Coulomb friction."""


@dataclass(frozen=True)
class JointLimits:
    """Bounds of a joint's effects: its `speed` (rad/s, m/s), the velocity limit or the largest
    recorded one, and the largest recorded `torque` (N m, N), which neither friction nor low
    harmonics exceed."""

    speed: float
    torque: float


@dataclass(frozen=True, eq=False)
class JointFit:
    """Effects of a joint with their coefficients by column, and what they leave of the torque,
    `residual` (N,). `kept`: {effect, share}, the share of the mean squared residual on left-out
    blocks that it removed when it was added. `before` and `after`: RMS of the residual of blocks
    predicted by the others, without and with the effects."""

    effects: JointEffects
    values: dict[str, float]
    kept: tuple[dict[str, Any], ...]
    residual: Array
    before: float
    after: float


@dataclass(frozen=True, eq=False)
class _Validated:
    """Effects and the mean squared residual of each left-out block (FOLDS,)."""

    effects: JointEffects
    errors: Array
    residual: Array = field(repr=False)

    @property
    def error(self) -> float:
        return float(np.mean(self.residual**2))

    def improves(self, other: "_Validated") -> bool:
        """True where the error is smaller by SMALLEST, and in the MAJORITY of the blocks."""
        # One block with much of an effect could carry the mean by itself: most blocks have to
        # agree.
        better = int((self.errors < other.errors).sum())
        return self.error < (1.0 - SMALLEST) * other.error and better >= MAJORITY


def select_effects(columns: JointColumns, groups: Collection[str], limits: JointLimits) -> JointFit:
    """Return the effects of a joint out of some groups, added one by one while left-out blocks
    keep them; those whose values no gear can have are left out."""
    folds, speed = columns.blocks, columns.speed
    best = start = _validated(columns, JointEffects(), folds)
    kept: list[dict[str, Any]] = []
    while True:
        # One further group at a time, in each of its shapes, beside those that are kept.
        further = best.effects.candidates(groups, speed)
        options = [_validated(columns, one, folds) for one in further]
        better = [
            one
            for one in options
            if one.improves(best) and is_feasible(_values(columns, one.effects), limits)
        ]
        if not better:
            break
        chosen = min(better, key=attrgetter("error"))
        share = 1.0 - chosen.error / best.error
        kept.append({"effect": chosen.effects.groups[-1], "share": share})
        best = chosen
    values = _values(columns, best.effects)
    # Blocks decide which effects there are; their sizes come from all samples.
    X, y = columns.matrix(best.effects), columns.torque_with_delay(best.effects.delay)
    residual = y - X @ np.array(list(values.values()))
    before, after = (float(np.sqrt(one.error)) for one in (start, best))
    return JointFit(best.effects, values, tuple(kept), residual, before, after)


def _values(columns: JointColumns, effects: JointEffects) -> dict[str, float]:
    """Coefficients by column, fitted to all samples."""
    X, y = columns.matrix(effects), columns.torque_with_delay(effects.delay)
    found = _solution(*_normal(X, y), effects.columns)
    return dict(zip(effects.columns, found.tolist(), strict=True))


def is_feasible(values: Mapping[str, float], limits: JointLimits) -> bool:
    """Return True for values (by column) that a gear can have."""
    friction = values["coulomb"] + values.get("stribeck", 0.0)
    curve = values.get("curved", 0.0) * limits.speed
    # With values beyond these a gear would lock or drive itself.
    harmonics = [
        np.hypot(values[f"sin {order}"], values[f"cos {order}"])
        for order in range(1, 4)
        if f"sin {order}" in values
    ]
    return bool(
        max([friction, *harmonics]) <= limits.torque
        and values.get("load", 0.0) <= LARGEST_LOAD
        and values.get("stribeck", 0.0) <= LARGEST_PEAK * values["coulomb"]
        and SMALLEST_CURVE * values["viscous"] <= curve <= LARGEST_CURVE * values["viscous"]
    )


def _validated(columns: JointColumns, effects: JointEffects, folds: Array) -> _Validated:
    """The effects with their residual on each block, predicted by the others."""
    X, y = columns.matrix(effects), columns.torque_with_delay(effects.delay)
    # Normal equations of a block are subtracted from the sum: all left-out fits read the samples
    # once. They suffice for a few columns that differ by far more than rounding.
    parts = [_normal(X[folds == f], y[folds == f]) for f in range(FOLDS)]
    G, g = (sum(part[i] for part in parts) for i in range(2))
    residual = np.empty_like(y)
    for f, (own, right) in enumerate(parts):
        left_out = folds == f
        beta = _solution(np.asarray(G - own), np.asarray(g - right), effects.columns)
        # Judged on what was not fitted: further columns always reduce the residual of the fit
        # itself.
        residual[left_out] = y[left_out] - X[left_out] @ beta
    errors = np.array([np.mean(residual[folds == f] ** 2) for f in range(FOLDS)])
    return _Validated(effects, errors, residual)


def _normal(X: Array, y: Array) -> tuple[Array, Array]:
    return X.T @ X, X.T @ y


def _solution(G: Array, g: Array, names: tuple[str, ...]) -> Array:
    """Coefficients (k,) of normal equations G x = g; those of NOT_NEGATIVE that would be negative
    are zero, and without viscous friction there is none that is curved."""
    free = np.ones(len(g), dtype=bool)
    signed, curved = np.isin(names, NOT_NEGATIVE), np.isin(names, "curved")
    while True:
        x = np.zeros(len(g))
        # Unit diagonal: the ridge is then the same share of each column, whatever its unit.
        scale = np.sqrt(np.maximum(np.diag(G)[free], 1e-300))
        scaled = G[np.ix_(free, free)] / np.outer(scale, scale)
        x[free] = np.linalg.solve(scaled + TINY * np.eye(len(scale)), g[free] / scale) / scale
        wrong = free & signed & (x < 0.0)
        if not wrong.any():
            return x
        # A removed column never returns, as it could in exact non-negative least squares.
        free &= ~wrong
        # Plant files state curvature relative to viscous friction: without this there is none.
        free &= ~curved | free[names.index("viscous")]
