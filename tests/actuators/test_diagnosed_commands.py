"""Mistakes in logs of position-commanded robots, planted one by one, and found by `diagnose`."""

from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import sysid_bench
from sysid_bench.types import Array
from tests.actuators.leg import JOINTS, MODEL, RATE, Case

SEEDS = [0, *(pytest.param(seed, marks=pytest.mark.long) for seed in range(1, 5))]


@cache
def recorded(seed: int) -> dict[str, Array]:
    """A recording without delay: the command of a sample acts from that sample on."""
    commands = Case(seed, delay=0.0, disturbance=0.03, noise=2e-5).commands()
    return {name: getattr(commands, name) for name in ("q", "q_des", "kp", "kd")}


def findings(folder: Path, data: dict[str, Array], **pd: object) -> dict[str, str]:
    """Messages of a diagnosis by the names of its findings, without notes."""
    file = folder / "leg.xml"
    file.write_text(MODEL, encoding="utf-8")
    controller = {"q_des": "q_des", "kp": "kp", "kd": "kd", "delay": "profile", **pd}
    keys: dict[str, Any] = {"joints": list(JOINTS), "rate": RATE, "tau": {"pd": controller}}
    result = sysid_bench.diagnose(sysid_bench.log_of(data, keys), file)
    found = [one for one in result.findings if one["severity"] != "note"]
    return {name: " ".join(one["message"] for one in found if one["name"] == name)
            for name in {one["name"] for one in found}}  # fmt: skip


@pytest.mark.parametrize("seed", SEEDS)
def test_planted_mistakes_are_found(tmp_path: Path, seed: int) -> None:
    data = recorded(seed)
    plain = findings(tmp_path, data)
    assert "columns" not in plain
    assert "limits" not in plain
    assert "stamped" not in plain.get("delay", "")
    swapped = findings(tmp_path, {**data, "q_des": data["q_des"][:, [1, 0, 2]]})
    assert "exchanged" in swapped["columns"]
    weak = findings(tmp_path, data, limit=float(np.quantile(np.abs(torque(data)), 0.9)))
    assert "torque limit" in weak["limits"]
    degrees = {**data, "kp": np.radians(data["kp"]), "kd": np.radians(data["kd"])}
    assert "degrees" in findings(tmp_path, degrees)["gain"]
    late = {name: x[1:] for name, x in data.items()} | {"q_des": data["q_des"][:-1]}
    assert "before they are stamped" in findings(tmp_path, late)["delay"]


def torque(data: dict[str, Array]) -> Array:
    """Torque that the controller asks for, without its damping."""
    return np.asarray(data["kp"] * (data["q_des"] - data["q"]))


@pytest.mark.filterwarnings("error::RuntimeWarning")
@pytest.mark.parametrize("count", [20, 25, 33, 60])
def test_a_recording_shorter_than_past_commands_leaves_no_warning(
    tmp_path: Path, count: int
) -> None:
    data = {name: x[:count] for name, x in recorded(0).items()}
    assert isinstance(findings(tmp_path, data, delay="4 ms"), dict)
