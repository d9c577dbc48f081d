"""Planted mistakes: what `sysid-bench diagnose` finds of them, and what they cost.

    SYSID_BENCH_DATA=... python -m reports.make.planted_mistakes [ROBOT...]

Every mistake is planted in a training recording, written to a file, read again and diagnosed; the
raise of the test error is that of a weighted fit to the faulty recording on an intact test motion.
"""

import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import tomlkit

from reports.make.recordings_to_diagnose import (
    RECORDED,
    SIMULATED,
    TUNED,
    Signals,
    Subject,
    subject,
)
from sysid_bench.diagnosis.diagnose_input import DiagnoseInput, terms
from sysid_bench.diagnosis.finding import NOTE, Finding
from sysid_bench.diagnosis.run_checks import diagnose
from sysid_bench.errors import UsageError
from sysid_bench.models.load import load_robot
from sysid_bench.models.manifest import find_manifest
from sysid_bench.models.robot import RobotModel
from sysid_bench.signals.log import read_log
from sysid_bench.signals.log_description import read_description
from sysid_bench.types import Array

DECISIVE: Final = 0.3
"""Raise of the test error from which a mistake must not stay silent."""

Change = Callable[[Signals, int, np.random.Generator], Signals]


@dataclass(frozen=True)
class Mistake:
    """A kind of mistake, planted by `change` in joint j, and the findings that name it."""

    name: str
    expected: tuple[str, ...]
    change: Change
    of_joint: bool = True
    robot: Callable[[RobotModel], RobotModel] | None = None


def _tau(change: Callable[[Array, int, Signals], Array]) -> Change:
    """A change of one torque column."""

    def planted(s: Signals, j: int, rng: np.random.Generator) -> Signals:
        tau = s.tau.copy()
        tau[:, j] = change(tau[:, j], j, s)
        return replace(s, tau=tau)

    return planted


def _times(q: float = 1.0, v: float = 1.0, tau: float = 1.0, every: bool = False) -> Change:
    """Factors on the columns of one joint, or of every one."""

    def planted(s: Signals, j: int, rng: np.random.Generator) -> Signals:
        part = slice(None) if every else slice(j, j + 1)
        new: dict[str, Any] = {name: getattr(s, name) for name in ("q", "v", "tau")}
        new = {name: None if x is None else x.copy() for name, x in new.items()}
        for name, factor in (("q", q), ("v", v), ("tau", tau)):
            column = new[name]
            if column is not None:
                column[:, part] *= factor
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
    def late(x: Array, j: int, s: Signals) -> Array:
        return np.asarray(np.interp(_time(s) - seconds, _time(s), x))

    return _tau(late)


def _time(s: Signals) -> Array:
    return s.t if s.stamps else np.arange(len(s.t)) / s.rate


def _without_v(change: Change) -> Change:
    return lambda s, j, rng: replace(change(s, j, rng), v=None)


def _clip(x: Array, j: int, s: Signals) -> Array:
    middle, reach = 0.5 * (x.max() + x.min()), 0.4 * 0.5 * np.ptp(x)
    return np.asarray(np.clip(x, middle - reach, middle + reach))


def _hold(x: Array, j: int, s: Signals) -> Array:
    return x[np.arange(len(x)) // 10 * 10]


def _spikes(factor: float) -> Change:
    def planted(s: Signals, j: int, rng: np.random.Generator) -> Signals:
        tau = s.tau.copy()
        rows = rng.choice(len(tau), max(3, len(tau) // 500), replace=False)
        tau[rows, j] = factor * np.sqrt((tau[:, j] ** 2).mean())
        return replace(s, tau=tau)

    return planted


def _moved(offset: float) -> Change:
    def planted(s: Signals, j: int, rng: np.random.Generator) -> Signals:
        q = s.q.copy()
        q[:, j] += offset
        return replace(s, q=q)

    return planted


def _rate(factor: float) -> Change:
    """A declared rate that is `factor` times the true one."""

    def planted(s: Signals, j: int, rng: np.random.Generator) -> Signals:
        step = np.median(np.diff(s.t)) if s.stamps else 1 / s.rate
        return replace(s, stamps=False, rate=factor / float(step))

    return planted


def _copy_of_velocity(s: Signals, j: int, rng: np.random.Generator) -> Signals:
    v = np.gradient(s.q, _time(s), axis=0) if s.v is None else s.v
    tau = s.tau.copy()
    tau[:, j] = v[:, j]
    return replace(s, tau=tau, v=v)


def _copy_of_torque(s: Signals, j: int, rng: np.random.Generator) -> Signals:
    tau = s.tau.copy()
    tau[:, j] = tau[:, (j + 1) % tau.shape[1]]
    return replace(s, tau=tau)


def _all_shifted(s: Signals, j: int, rng: np.random.Generator) -> Signals:
    return replace(s, tau=np.roll(s.tau, 1, axis=1))


def _stamped(change: Callable[[Array, np.random.Generator], Array]) -> Change:
    def planted(s: Signals, j: int, rng: np.random.Generator) -> Signals:
        return replace(s, stamps=True, t=change(_time(s).copy(), rng))

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


def _holes(s: Signals, j: int, rng: np.random.Generator) -> Signals:
    tau = s.tau.copy()
    tau[rng.random(len(tau)) < 0.05, j] = np.nan
    return replace(s, tau=tau)


def _same(s: Signals, j: int, rng: np.random.Generator) -> Signals:
    return s


def _mounted(robot: RobotModel) -> RobotModel:
    """The robot's file with gravity along another axis."""
    g = robot.tree.gravity
    return replace(robot, tree=replace(robot.tree, gravity=np.roll(g, 1)))


OTHER: Final = {"ur5": "ur3", "ur3": "ur5", "ur10": "ur5", "ur10e": "ur3"}
"""Robots whose joints have the same names."""


def _other(robot: RobotModel) -> RobotModel:
    """The model of another robot, the same one where there is none."""
    return load_robot(find_manifest(OTHER[robot.name])) if robot.name in OTHER else robot


DEGREES: Final = 180 / np.pi
MISTAKES: Final = (
    Mistake("torque sign, all", ("sign",), _times(tau=-1, every=True), False),
    Mistake("torque sign, one", ("sign",), _times(tau=-1)),
    Mistake("torque x 10, one", ("gain", "units"), _times(tau=10)),
    Mistake("torque x 0.1, one", ("gain",), _times(tau=0.1)),
    Mistake("torque x 2, one", ("gain",), _times(tau=2)),
    Mistake("torque x 180/pi, one", ("gain", "units"), _times(tau=DEGREES)),
    Mistake("torque in mN m, all", ("gain", "units"), _times(tau=1e3, every=True), False),
    Mistake("torque of motors, 1:100", ("gain",), _times(tau=0.01, every=True), False),
    Mistake("torque of a motor, 1:50, one", ("gain",), _times(tau=0.02)),
    Mistake("torque columns exchanged", ("columns",), _exchange("tau")),
    Mistake("torque columns shifted", ("columns",), _all_shifted, False),
    Mistake("torque column zero", ("zero",), _times(tau=0)),
    Mistake("torque = velocity", ("copied",), _copy_of_velocity),
    Mistake("torque = another torque", ("copied",), _copy_of_torque),
    Mistake("torque 50 ms late", ("delay",), _late(0.05)),
    Mistake("torque 30 ms late", ("delay",), _late(0.03)),
    Mistake("torque clipped at 40 %", ("clipped",), _tau(_clip)),
    Mistake("torque held for 10 samples", ("held", "delay"), _tau(_hold)),
    Mistake("torque spikes x 20", ("spikes",), _spikes(20.0)),
    Mistake("torque spikes x 1e6", ("spikes", "units"), _spikes(1e6)),
    Mistake(
        "q in deg, no v", ("units", "limits"), _without_v(_times(q=DEGREES, every=True)), False
    ),
    Mistake("q in deg", ("units", "rate", "velocity"), _times(q=DEGREES, every=True), False),
    Mistake("v in deg/s", ("units", "rate", "velocity"), _times(v=DEGREES, every=True), False),
    Mistake("q columns exchanged, no v", ("columns",), _without_v(_exchange("q"))),
    Mistake("q and v columns exchanged", ("columns",), _exchange("q", "v")),
    Mistake("q columns exchanged, v not", ("velocity",), _exchange("q")),
    Mistake("joints exchanged", ("columns",), _exchange("q", "v", "tau")),
    Mistake("direction of q and v", ("direction",), _times(q=-1, v=-1)),
    Mistake("direction of q, v not", ("velocity",), _times(q=-1)),
    Mistake("direction of q, no v", ("direction",), _without_v(_times(q=-1))),
    Mistake("axis reversed: q, v, tau", ("direction",), _times(q=-1, v=-1, tau=-1)),
    Mistake("zero off by 0.3 rad", ("offset",), _moved(0.3)),
    Mistake("zero off by 90 deg", ("offset", "units", "limits"), _moved(0.5 * np.pi)),
    Mistake("rate halved", ("rate",), _rate(0.5), False),
    Mistake("rate halved, no v", ("rate",), _without_v(_rate(0.5)), False),
    Mistake("rate doubled, no v", ("rate",), _without_v(_rate(2.0)), False),
    Mistake("stamps in ms", ("rate", "time"), _stamped(lambda t, rng: 1e3 * t), False),
    Mistake("stamps backwards", ("time",), _stamped(lambda t, rng: t[::-1]), False),
    Mistake("one wild stamp", ("time",), _stamped(_wild), False),
    Mistake("nine wild stamps first", ("time",), _stamped(_wild_head), False),
    Mistake("5 % of stamps repeated", ("time",), _stamped(_repeated), False),
    Mistake("5 % of one torque not finite", ("non-finite",), _holes),
    Mistake("gravity along another axis", ("gravity",), _same, False, _mounted),
    Mistake("model of another robot", ("robot", "gain"), _same, False, _other),
)


def write(folder: Path, signals: Signals) -> Path:
    """The recording as a file with its description."""
    arrays: dict[str, Any] = {"t": signals.t, "q": signals.q, "tau": signals.tau}
    k = len(signals.joints)
    names = {s: [f"{s}:{i + 1}" for i in range(k)] for s in ("q", "v", "tau")}
    text: dict[str, Any] = {"file": "run.npz", "joints": list(signals.joints)}
    text |= {"time": "t"} if signals.stamps else {"rate": f"{signals.rate:.9g} Hz"}
    if signals.v is not None:
        arrays["v"] = signals.v
    text |= {s: {"columns": names[s]} for s in ("q", "v", "tau") if s in arrays}
    np.savez(folder / "run.npz", **arrays)
    path = folder / "run.toml"
    path.write_text(tomlkit.dumps(text))
    return path


def evidence(signals: Signals, robot: RobotModel) -> DiagnoseInput:
    """The recording as it is read from a file."""
    with tempfile.TemporaryDirectory() as folder:
        return DiagnoseInput(read_log(read_description(write(Path(folder), signals)), robot), robot)


def test_error(training: DiagnoseInput, test: DiagnoseInput) -> float:
    """Error on the test motion of a fit to the training one, over the RMS of the test torque; each
    joint divided by its own, like `torque_error`."""
    W, b, _ = _stacked(training)
    size = np.linalg.norm(W, axis=0)
    kept = size > 1e-9 * size.max()
    beta, *_ = np.linalg.lstsq(W[:, kept] / size[kept], b, rcond=1e-6)
    A, target, scale = _stacked(test)
    predicted = _unweighted(A[:, kept] / size[kept] @ beta, scale)
    measured = _unweighted(target, scale)
    rms = np.sqrt((measured**2).mean(axis=0))
    used = rms > 0.01 * rms.max()
    return float(np.sqrt((((predicted - measured) / np.maximum(rms, 1e-12))[:, used] ** 2).mean()))


def _stacked(e: DiagnoseInput) -> tuple[Array, Array, Array]:
    """Rows W, b of all joints, each over its RMS torque, and these RMS torques (n,)."""
    motion, tau = e.fit_samples
    own = terms(motion)
    links = e.regressor(motion)
    N, n, m = own.shape
    rms = np.maximum(np.sqrt((tau**2).mean(axis=0)), 1e-12)
    blocks = np.zeros((N, n, n * m))
    for j in range(n):
        blocks[:, j, j * m : (j + 1) * m] = own[:, j]
    W = np.concatenate([links, blocks], axis=2) / rms[:, None]
    return W.reshape(N * n, -1), (tau / rms).ravel(), rms


def _unweighted(x: Array, rms: Array) -> Array:
    return np.asarray(x.reshape(-1, len(rms)) * rms)


@dataclass(frozen=True)
class Row:
    """What a mistake costs and what was found of it; `first` names the first finding."""

    robot: str
    mistake: str
    joint: str
    raised: float
    found: bool
    named: bool
    first: str

    @property
    def is_decisive(self) -> bool:
        """True where the mistake must not stay silent."""
        return self.raised >= DECISIVE


def clean_row(one: Subject) -> tuple[list[Finding], float, DiagnoseInput]:
    """Findings in the intact recording, its test error, and the evidence of the test."""
    test = evidence(one.test, one.robot)
    training = evidence(one.training, one.robot)
    return [f for f in diagnose(training) if f.severity != NOTE], test_error(training, test), test


def rows_of(one: Subject) -> Iterator[Row]:
    """All mistakes on one robot, joint by joint in turn."""
    clean, reference, test = clean_row(one)
    yield Row(one.name, "(none)", "", reference, bool(clean), False, _texts(clean))
    for k, mistake in enumerate(MISTAKES):
        yield _row(one, mistake, k % len(one.training.joints), (clean, reference, test))


def _row(
    one: Subject, mistake: Mistake, j: int, base: tuple[list[Finding], float, DiagnoseInput]
) -> Row:
    clean, reference, test = base
    joint = one.training.joints[j] if mistake.of_joint else ""
    robot = one.robot if mistake.robot is None else mistake.robot(one.robot)
    planted = mistake.change(one.training, j, np.random.default_rng(j))
    try:
        faulty = evidence(planted, robot)
    except UsageError as error:
        text = str(error)
        named = any(word in text for word in (*mistake.expected, "stamp", "gap"))
        return Row(one.name, mistake.name, joint, np.inf, True, named, f"refused: {text[-100:]}")
    raised = test_error(faulty, replace(test, robot=robot)) - reference
    known = {(f.name, f.joints) for f in clean}
    new = [f for f in diagnose(faulty) if f.severity != NOTE and (f.name, f.joints) not in known]
    named = bool(new) and new[0].name in mistake.expected
    if named and joint and new[0].joints:
        named = joint in new[0].joints
    return Row(one.name, mistake.name, joint, raised, bool(new), named, _texts(new[:1]))


def _texts(findings: list[Finding]) -> str:
    return "; ".join(f"{f.severity} {f.name} {','.join(f.joints)}: {f.message}" for f in findings)


def summary(rows: list[Row]) -> str:
    """Counts of the robots on which no threshold was set."""
    planted = [row for row in rows if row.mistake != "(none)"]
    decisive = [row for row in planted if row.is_decisive]
    silent = [row for row in decisive if not row.found]
    named = sum(row.named for row in decisive)
    lines = [
        f"{len(planted)} planted, {len(decisive)} raise the test error by {DECISIVE} or more: "
        f"{len(silent)} silent, right cause first in {named} "
        f"({100 * named / max(len(decisive), 1):.0f} %)"
    ]
    lines += [f"  silent: {r.robot} {r.mistake} {r.joint} +{r.raised:.2f}" for r in silent]
    return "\n".join(lines)


def main(names: list[str]) -> None:
    """Print one line per robot and mistake, then the counts of both halves."""
    chosen = names or [*RECORDED, *(f"sim:{name}" for name in SIMULATED)]
    rows: list[Row] = []
    for name in chosen:
        for row in rows_of(subject(name)):
            rows.append(row)
            mark = "named" if row.named else "found" if row.found else "-"
            print(
                f"{row.robot:10} {row.mistake:30} {row.joint:20} {row.raised:8.2f} {mark:6} "
                f"{row.first[:140]}",
                flush=True,
            )
    halves: Mapping[str, bool] = {"thresholds set on these": True, "others": False}
    for title, tuned in halves.items():
        part = [r for r in rows if (r.robot.removeprefix("sim:") in TUNED) is tuned]
        if part:
            print(f"\n{title}: {summary(part)}")


if __name__ == "__main__":
    main(sys.argv[1:])
