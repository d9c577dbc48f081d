"""Recordings of simulated robots as files: what the laws of the importer are tried on."""

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import tomlkit
from scipy.io import savemat

from sysid_bench.excitation.design_problem import design_problem
from sysid_bench.excitation.random_motions import Fourier
from sysid_bench.models.robot import RobotModel
from sysid_bench.signals.log import Log, read_log
from sysid_bench.signals.log_description import read_description
from sysid_bench.simulation.inverse import Inverse
from sysid_bench.simulation.plant import plant_of
from sysid_bench.types import Array, Oracle
from tests.robots import named_robot

RATE = 200.0


@dataclass(frozen=True, eq=False)
class Recorded:
    """Signals (N, k) of some joints of a robot, SI, joint side."""

    joints: tuple[str, ...]
    t: Array
    q: Array
    v: Array
    tau: Array


def motion_of(robot: RobotModel, seed: int = 0, period: float = 4.0, rate: float = RATE) -> Oracle:
    """An exciting motion of a robot with its torque."""
    commanded = Fourier(period=period, cycles=1).design(
        design_problem(robot, rate), np.random.default_rng(seed)
    )
    oracle, _ = Inverse().run(plant_of(robot), commanded, np.zeros_like(commanded.v))
    return oracle


def recorded(robot: RobotModel, seed: int = 0, period: float = 4.0) -> Recorded:
    """What a robot of hinges and slides would log along an exciting motion."""
    oracle = motion_of(robot, seed, period)
    at = [joint.qadr for joint in robot.joints]
    motion = oracle.motion
    return Recorded(robot.rows, motion.t, motion.q[:, at], motion.v, oracle.tau)


def write(
    folder: Path, log: Recorded, kind: str = "csv", name: str = "run", **changed: Any
) -> Path:
    """A recorded file and its description with the keys in `changed` (None: left out)."""
    k = len(log.joints)
    table = np.column_stack([log.t, log.q, log.v, log.tau])
    file = folder / f"{name}.{kind.partition(' ')[0]}"
    words = ["t", *(f"{s}_{j}" for s in ("q", "v", "tau") for j in log.joints)]
    arrays: dict[str, Any] = {"t": log.t, "q": log.q, "v": log.v, "tau": log.tau}
    by_place: dict[str, Any] = {
        s: {"columns": list(range(2 + i * k, 2 + (i + 1) * k))}
        for i, s in enumerate(("q", "v", "tau"))
    }
    by_array: dict[str, Any] = {s: {"columns": [s]} for s in ("q", "v", "tau")}
    match kind:
        case "csv":
            np.savetxt(file, table, delimiter=",", header=",".join(words), comments="", fmt="%.17g")
        case "csv bare":
            np.savetxt(file, table, delimiter=",", fmt="%.17g")
        case "csv ;":
            np.savetxt(file, table, delimiter=" ; ", header=";".join(words), fmt="%.17g")
        case "txt":
            np.savetxt(
                file, table, header="one more line of words\n" + " ".join(words), fmt="%.17g"
            )
        case "npz":
            np.savez(file, **arrays)
        case "mat":
            savemat(file, {"run": {"q": log.q.T, "v": log.v, "tau": log.tau.T}, "t": log.t})
            by_array = {s: {"columns": [f"run.{s}"]} for s in ("q", "v", "tau")}
        case "parquet":
            pd.DataFrame(table, columns=words).to_parquet(file)
            by_place = {s: {"columns": [f"{s}_{j}" for j in log.joints]} for s in ("q", "v", "tau")}
    signals = by_array if kind in ("npz", "mat") else by_place
    text: dict[str, Any] = {"file": file.name, "rate": f"{RATE:g} Hz", "joints": list(log.joints)}
    text |= {s: dict(part) for s, part in signals.items()}
    for key, value in changed.items():
        if value is None:
            text.pop(key, None)
        elif isinstance(value, Mapping) and isinstance(text.get(key), dict):
            text[key] = text[key] | dict(value)
        else:
            text[key] = value
    path = folder / f"{name}.toml"
    path.write_text(tomlkit.dumps(text))
    assert tomllib.loads(path.read_text()).keys() == text.keys()
    return path


@dataclass(frozen=True, eq=False)
class World:
    """A robot of hinges and slides, and a folder for its recordings."""

    robot: RobotModel
    folder: Path

    def write(self, log: Recorded, kind: str = "csv", name: str = "run", **changed: Any) -> Path:
        """A recorded file and its description."""
        return write(self.folder, log, kind, name, **changed)

    def read_file(self, path: Path) -> Log:
        """The recording of a description."""
        return read_log(read_description(path), self.robot)

    def read(self, log: Recorded, kind: str = "csv", name: str = "run", **changed: Any) -> Log:
        """A recording that was written, read again."""
        return self.read_file(self.write(log, kind, name, **changed))

    def same(self, got: Log, log: Recorded, atol: float = 1e-9) -> None:
        """Fail unless the signals come back."""
        at = [joint.qadr for joint in self.robot.joints]
        assert got.recording.v is not None
        for name, x, y in (
            ("q", got.recording.q[:, at], log.q),
            ("v", got.recording.v, log.v),
            ("tau", got.recording.tau, log.tau),
        ):
            np.testing.assert_allclose(x, y, rtol=0, atol=atol * np.abs(y).max(), err_msg=name)
        assert got.recording.rate == pytest.approx(RATE, rel=1e-6)


def write_two(folder: Path) -> Path:
    """The folder with run.toml and other.toml, two motions of a ur5."""
    write(folder, recorded(named_robot("ur5"), 0))
    write(folder, recorded(named_robot("ur5"), 1), name="other")
    return folder
