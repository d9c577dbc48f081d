"""Mistakes that are planted in recordings, with the findings that name them; harmless changes."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np

from reports.make.recordings_to_diagnose import Signals
from sysid_bench.models.load import load_robot
from sysid_bench.models.manifest import find_manifest
from sysid_bench.models.robot import RobotModel
from sysid_bench.signals.filter import Butterworth, derivative
from sysid_bench.types import Array

Change = Callable[[Signals, int, np.random.Generator], Signals]


@dataclass(frozen=True)
class Mistake:
    """A kind of mistake, planted by `change` in joint j, and the findings that name it. `robot`: a
    model that is not that of the recording. `is_harmless`: a change that leaves the recording
    usable."""

    name: str
    expected: tuple[str, ...]
    change: Change
    of_joint: bool = True
    robot: Callable[[RobotModel], RobotModel] | None = None
    is_harmless: bool = False
    of_velocity: bool = False  # the same as another one where no velocities are recorded


def times(s: Signals) -> Array:
    """Times (N,) of the samples."""
    return s.t if s.stamps else np.arange(len(s.t)) / s.rate


def _tau(change: Callable[[Array, int, Signals], Array]) -> Change:
    """A change of one torque column."""

    def planted(s: Signals, j: int, rng: np.random.Generator) -> Signals:
        tau = s.tau.copy()
        tau[:, j] = change(tau[:, j], j, s)
        return replace(s, tau=tau)

    return planted


def _times(q: float = 1.0, v: float = 1.0, tau: float = 1.0, every: int = 0) -> Change:
    """Factors on the columns of one joint, of `every` neighbours, or of all joints (-1)."""

    def planted(s: Signals, j: int, rng: np.random.Generator) -> Signals:
        n = len(s.joints)
        part = range(n) if every < 0 else [(j + k) % n for k in range(min(max(every, 1), n - 1))]
        new: dict[str, Any] = {name: getattr(s, name) for name in ("q", "v", "tau")}
        new = {name: None if x is None else x.copy() for name, x in new.items()}
        for name, factor in (("q", q), ("v", v), ("tau", tau)):
            if new[name] is not None:
                new[name][:, list(part)] *= factor
        return replace(s, **new)

    return planted


def _exchange(*signals: str) -> Change:
    """Columns of a joint and its neighbour exchanged."""

    def planted(s: Signals, j: int, rng: np.random.Generator) -> Signals:
        order = list(range(len(s.joints)))
        i = (j + 1) % len(order)
        order[i], order[j] = j, i
        new: dict[str, Any] = {name: getattr(s, name) for name in signals}
        new = {name: None if x is None else x[:, order] for name, x in new.items()}
        return replace(s, **new)

    return planted


def _late(seconds: float) -> Change:
    return _tau(lambda x, j, s: np.asarray(np.interp(times(s) - seconds, times(s), x)))


def _without_v(change: Change) -> Change:
    return lambda s, j, rng: replace(change(s, j, rng), v=None)


def _clip(x: Array, j: int, s: Signals) -> Array:
    middle, reach = 0.5 * (x.max() + x.min()), 0.4 * 0.5 * np.ptp(x)
    return np.asarray(np.clip(x, middle - reach, middle + reach))


def _spikes(factor: float) -> Change:
    def planted(s: Signals, j: int, rng: np.random.Generator) -> Signals:
        tau = s.tau.copy()
        rows = rng.choice(len(tau), max(3, len(tau) // 500), replace=False)
        tau[rows, j] = factor * np.sqrt((tau[:, j] ** 2).mean())
        return replace(s, tau=tau)

    return planted


def _moved(offset: float) -> Change:
    return lambda s, j, rng: replace(s, q=s.q + offset * np.eye(len(s.joints))[j])


def _rate(factor: float) -> Change:
    """A declared rate that is `factor` times the true one."""

    def planted(s: Signals, j: int, rng: np.random.Generator) -> Signals:
        step = np.median(np.diff(s.t)) if s.stamps else 1 / s.rate
        return replace(s, stamps=False, rate=factor / float(step))

    return planted


def _derivative(s: Signals, order: int) -> Array:
    """Derivatives (N, n) of the positions, up to 10 Hz and a tenth of the rate."""
    t = np.maximum.accumulate(times(s))
    grid = np.linspace(t[0], t[-1], len(t))
    rate = (len(t) - 1) / (t[-1] - t[0])
    low_pass = Butterworth(3, min(10.0, 0.1 * rate))
    x = np.column_stack([np.interp(grid, t, column) for column in s.q.T])
    for _ in range(order):
        x = derivative(low_pass, x, rate)
    return np.column_stack([np.interp(t, grid, column) for column in x.T])


def _velocity(s: Signals) -> Array:
    return _derivative(s, 1) if s.v is None else s.v


def _copy_of_velocity(s: Signals, j: int, rng: np.random.Generator) -> Signals:
    tau = s.tau.copy()
    tau[:, j] = _velocity(s)[:, j]
    return replace(s, tau=tau, v=_velocity(s))


def _copy_of_torque(s: Signals, j: int, rng: np.random.Generator) -> Signals:
    tau = s.tau.copy()
    tau[:, j] = tau[:, (j + 1) % tau.shape[1]]
    return replace(s, tau=tau)


def _currents(s: Signals, j: int, rng: np.random.Generator) -> Signals:
    """Currents of the drives in the place of torques: those recorded, or of drawn constants."""
    gains = np.exp(rng.uniform(np.log(5.0), np.log(50.0), s.tau.shape[1]))
    return replace(s, tau=s.tau / (gains if s.gains is None else s.gains))


def _wrapped(s: Signals, j: int, rng: np.random.Generator) -> Signals:
    """Positions within one turn that ends inside of the joint's range."""
    if not s.hinges[j]:
        return s
    q = s.q.copy()
    q[:, j] = np.where(q[:, j] < np.quantile(q[:, j], 0.3), q[:, j] + 2 * np.pi, q[:, j])
    return replace(s, q=q)


def _stamped(change: Callable[[Array, np.random.Generator], Array]) -> Change:
    def planted(s: Signals, j: int, rng: np.random.Generator) -> Signals:
        return replace(s, stamps=True, t=change(times(s).copy(), rng))

    return planted


def _wild(t: Array, rng: np.random.Generator) -> Array:
    t[rng.choice(len(t) // 2)] = 1e9
    return t


def _wild_head(t: Array, rng: np.random.Generator) -> Array:
    t[:9] = rng.uniform(1e6, 1e9, 9)
    return t


def _repeated(t: Array, rng: np.random.Generator) -> Array:
    rows = rng.choice(len(t) - 1, len(t) // 20, replace=False)
    t[rows + 1] = t[rows]
    return t


def _jittered(share: float) -> Callable[[Array, np.random.Generator], Array]:
    """Stamps off by a share of the step."""

    def jittered(t: Array, rng: np.random.Generator) -> Array:
        return t + share * float(np.median(np.diff(t))) * rng.uniform(-1, 1, len(t))

    return jittered


def _repeated_rows(s: Signals, j: int, rng: np.random.Generator) -> Signals:
    """Rows of which 5 % hold the numbers of the row before, at stamps of their own."""
    at = np.arange(len(s.t))
    rows = 1 + rng.choice(len(s.t) - 1, len(s.t) // 20, replace=False)
    at[rows] -= 1
    return replace(s, q=s.q[at], tau=s.tau[at], v=None if s.v is None else s.v[at])


def _written_twice(s: Signals, j: int, rng: np.random.Generator) -> Signals:
    """Rows of which 5 % stand twice in the file, stamps too."""
    at = np.sort(np.append(np.arange(len(s.t)), rng.choice(len(s.t), len(s.t) // 20)))
    v = None if s.v is None else s.v[at]
    return replace(s, stamps=True, t=times(s)[at], q=s.q[at], tau=s.tau[at], v=v)


def _constant_velocity(s: Signals, j: int, rng: np.random.Generator) -> Signals:
    v = _velocity(s).copy()
    v[:, j] = 0.0
    return replace(s, v=v)


def _holes(share: float) -> Change:
    def planted(s: Signals, j: int, rng: np.random.Generator) -> Signals:
        tau = s.tau.copy()
        tau[rng.random(len(tau)) < share, j] = np.nan
        return replace(s, tau=tau)

    return planted


def _same(s: Signals, j: int, rng: np.random.Generator) -> Signals:
    return s


def _mounted(robot: RobotModel) -> RobotModel:
    """The robot's file with gravity along another axis."""
    return replace(robot, tree=replace(robot.tree, gravity=np.roll(robot.tree.gravity, 1)))


def _tilted(robot: RobotModel) -> RobotModel:
    """The robot's file with its base tilted by 15 degrees."""
    c, s = np.cos(np.radians(15)), np.sin(np.radians(15))
    R = np.array([[1, 0, 0], [0, c, -s], [0, s, c]])
    return replace(robot, tree=replace(robot.tree, gravity=R @ robot.tree.gravity))


OTHER: Final = {"ur5": "ur3", "ur3": "ur5", "ur10": "ur5", "ur10e": "ur3"}
"""Robots whose joints have the same names."""


def _other(robot: RobotModel) -> RobotModel:
    """The model of another robot, the same one where there is none."""
    name = robot.name.removeprefix("dataset:")
    return load_robot(find_manifest(OTHER[name])) if name in OTHER else robot


DEGREES: Final = 180 / np.pi
MISTAKES: Final = (
    Mistake("torque sign, all", ("sign",), _times(tau=-1, every=-1), False),
    Mistake("torque sign, one", ("sign",), _times(tau=-1)),
    Mistake(
        "torque without sign, all", ("magnitude",),
        lambda s, j, rng: replace(s, tau=np.abs(s.tau)), False),
    Mistake("torque without sign, one", ("magnitude",), _tau(lambda x, j, s: np.abs(x))),
    Mistake("torque x 10, one", ("gain", "units", "current"), _times(tau=10)),
    Mistake("torque x 0.1, one", ("gain",), _times(tau=0.1)),
    Mistake("torque x 2, one", ("gain",), _times(tau=2)),
    Mistake("torque x 1.4, three", ("gain",), _times(tau=1.4, every=3), False),
    Mistake("torque x 0.7, all", ("gain",), _times(tau=0.7, every=-1), False),
    Mistake("torque x 2, all", ("gain",), _times(tau=2, every=-1), False),
    Mistake("torque x 100, all", ("gain", "units"), _times(tau=100, every=-1), False),
    Mistake("torque x 180/pi, one", ("gain", "units"), _times(tau=DEGREES)),
    Mistake("torque in mN m, all", ("gain", "units"), _times(tau=1e3, every=-1), False),
    Mistake("torque of motors, 1:100", ("gain", "current"), _times(tau=0.01, every=-1), False),
    Mistake("torque of a motor, 1:50, one", ("gain",), _times(tau=0.02)),
    Mistake("torque times the gear twice", ("gain", "units"), _times(tau=100, every=3), False),
    # Drives of nearly equal torque constants: one gain of all joints gives the torques back.
    Mistake("torque = current", ("current", "gain"), _currents, False),
    Mistake("torque columns exchanged", ("columns",), _exchange("tau")),
    Mistake("torque columns shifted", ("columns",),
            lambda s, j, rng: replace(s, tau=np.roll(s.tau, 1, axis=1)), False),
    Mistake("torque column zero", ("zero",), _times(tau=0)),
    Mistake("torque = acceleration", ("copied",),
            lambda s, j, rng: replace(s, tau=_derivative(s, 2)), False),
    Mistake("torque = velocity", ("copied",),
            lambda s, j, rng: replace(s, tau=_velocity(s)), False),
    Mistake("torque = velocity, one", ("copied",), _copy_of_velocity),
    Mistake("torque = position", ("copied",), lambda s, j, rng: replace(s, tau=s.q), False),
    Mistake("torque = another torque", ("copied",), _copy_of_torque),
    Mistake("torque 50 ms late", ("delay",), _late(0.05)),
    Mistake("torque 30 ms late", ("delay",), _late(0.03)),
    Mistake("torque clipped at 40 %", ("clipped",), _tau(_clip)),
    Mistake("torque held for 10 samples", ("held", "delay"),
            _tau(lambda x, j, s: x[np.arange(len(x)) // 10 * 10])),
    Mistake("torque spikes x 20", ("spikes",), _spikes(20.0)),
    Mistake("torque spikes x 1e6", ("spikes", "units"), _spikes(1e6)),
    Mistake("q in deg, no v", ("units", "limits"), _without_v(_times(q=DEGREES, every=-1)), False),
    Mistake("q in deg", ("units", "rate", "velocity"), _times(q=DEGREES, every=-1), False),
    Mistake("v in deg/s", ("units", "rate", "velocity"), _times(v=DEGREES, every=-1), False,
            of_velocity=True),
    Mistake("q wrapped at a turn", ("wrapped",), _wrapped),
    Mistake("q wrapped at a turn, no v", ("wrapped",), _without_v(_wrapped)),
    Mistake("v = position", ("velocity", "copied"), lambda s, j, rng: replace(s, v=s.q), False,
            of_velocity=True),
    Mistake("q = velocity", ("velocity", "copied", "units"),
            lambda s, j, rng: replace(s, q=_velocity(s), v=_velocity(s)), False),
    Mistake("q columns exchanged, no v", ("columns",), _without_v(_exchange("q"))),
    Mistake("q and v columns exchanged", ("columns",), _exchange("q", "v")),
    Mistake("q columns exchanged, v not", ("velocity",), _exchange("q"), of_velocity=True),
    Mistake("joints exchanged", ("columns",), _exchange("q", "v", "tau")),
    Mistake("direction of q and v", ("direction",), _times(q=-1, v=-1)),
    Mistake("direction of q, v not", ("velocity",), _times(q=-1), of_velocity=True),
    Mistake("direction of q, no v", ("direction",), _without_v(_times(q=-1))),
    Mistake("axis reversed: q, v, tau", ("direction",), _times(q=-1, v=-1, tau=-1)),
    Mistake("zero off by 0.3 rad", ("offset",), _moved(0.3)),
    Mistake("zero off by 90 deg", ("offset", "units", "limits"), _moved(0.5 * np.pi)),
    Mistake("rate halved", ("rate",), _rate(0.5), False, of_velocity=True),
    Mistake("rate halved, no v", ("rate",), _without_v(_rate(0.5)), False),
    Mistake("rate doubled, no v", ("rate",), _without_v(_rate(2.0)), False),
    Mistake("stamps in ms", ("rate", "time"), _stamped(lambda t, rng: 1e3 * t), False),
    Mistake("stamps backwards", ("time",), _stamped(lambda t, rng: t[::-1]), False),
    Mistake("5 % of one torque not finite", ("non-finite",), _holes(0.05)),
    Mistake("gravity along another axis", ("gravity",), _same, False, _mounted),
    Mistake("base tilted by 15 degrees", ("gravity",), _same, False, _tilted),
    Mistake("model of another robot", ("robot", "gain"), _same, False, _other),
)  # fmt: skip
HARMLESS: Final = (
    Mistake("stamps off by 5 % of a step", (), _stamped(_jittered(0.05)), False, None, True),
    Mistake("stamps off by 30 % of a step", (), _stamped(_jittered(0.3)), False, None, True),
    Mistake("stamps in whole ms", (), _stamped(lambda t, rng: np.round(t, 3)), False, None, True),
    Mistake("5 % of stamps repeated", (), _stamped(_repeated), False, None, True),
    Mistake("5 % of rows repeated", (), _repeated_rows, False, None, True),
    Mistake("5 % of rows written twice", (), _written_twice, False, None, True),
    Mistake("one wild stamp", (), _stamped(_wild), False, None, True),
    Mistake("nine wild stamps first", (), _stamped(_wild_head), False, None, True),
    Mistake("1 % of one torque not finite", (), _holes(0.01), True, None, True),
    Mistake("v of one joint constant", (), _constant_velocity, True, None, True),
    Mistake("no velocities", (), _without_v(_same), False, None, True),
)
