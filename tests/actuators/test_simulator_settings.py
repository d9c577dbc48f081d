"""Configurations to paste, and covariances: what simulators read is what was identified."""

import json
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import sysid_bench
from sysid_bench.apps.actuators.commands.actuators_result import ActuatorsResult
from sysid_bench.apps.actuators.drive_estimate import repeat_covariance
from sysid_bench.apps.actuators.drive_rows import UNKNOWNS
from sysid_bench.apps.actuators.written_model import STEP, JointSettings, settings_text
from sysid_bench.models.manifest import find_manifest
from sysid_bench.models.mjcf import stated_actuators
from tests.actuators.leg import JOINTS, MODEL, RATE, Case
from tests.closeness import assert_close

JOINT = JointSettings(kp=20.0, kd=1.0, limit=23.7, armature=0.012, damping=0.2, friction=0.3)


def read(text: str) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """Names that a configuration sets, and the fields of its actuators."""
    made: list[dict[str, Any]] = []
    names: dict[str, Any] = {}
    classes = {
        name: lambda **fields: made.append(fields)
        for name in ("BuiltinPositionActuatorCfg", "DelayedPDActuatorCfg")
    }
    exec(text, classes, names)
    return names, made


@pytest.mark.parametrize("limit", [23.7, np.inf])
def test_configurations_are_python_with_the_values(limit: float) -> None:
    joints = {name: JointSettings(**{**vars(JOINT), "limit": limit}) for name in ("hip.a", "knee")}
    texts = settings_text(joints, (0.0024, 0.0051))
    _, made = read(texts["mjlab"])
    assert [one["target_names_expr"] for one in made] == [(r"hip\.a",), ("knee",)]
    for one in made:
        assert (one["stiffness"], one["damping"], one["armature"]) == (20.0, 1.0, 0.012)
        assert (one["frictionloss"], one["viscous_damping"]) == (0.3, 0.2)
        assert ("effort_limit" in one) == np.isfinite(limit)
        # Delays are rounded outward to physics steps.
        assert one["delay_min_lag"] * STEP <= 0.0024
        assert one["delay_max_lag"] * STEP >= 0.0051
    _, (isaac,) = read(texts["isaaclab"])
    assert isaac["armature"] == {r"hip\.a": 0.012, "knee": 0.012}
    assert isaac["friction"] == isaac["dynamic_friction"] == {r"hip\.a": 0.3, "knee": 0.3}
    assert isaac["viscous_friction"]["knee"] == 0.2
    assert (isaac["min_delay"], isaac["max_delay"]) == (0, 2)
    assert ("effort_limit" in isaac) == np.isfinite(limit)


@pytest.mark.parametrize(("slides", "unit"), [(False, np.pi / 180.0), (True, 1.0)])
def test_attributes_of_usd_count_angles_in_degrees(slides: bool, unit: float) -> None:
    joints = {"knee": replace(JOINT, slides=slides), "free": replace(JOINT, limit=np.inf)}
    found = json.loads(settings_text(joints, (0.0, 0.0))["usd"])
    kind = "linear" if slides else "angular"
    drive, axis = f"drive:{kind}:physics", f"physxJointAxis:{kind}"
    assert found["knee"] == pytest.approx({
        f"{drive}:stiffness": 20.0 * unit, f"{drive}:damping": unit, f"{drive}:maxForce": 23.7,
        f"{axis}:armature": 0.012, f"{axis}:staticFrictionEffort": 0.3,
        f"{axis}:dynamicFrictionEffort": 0.3, f"{axis}:viscousFrictionCoefficient": 0.2 * unit,
    })  # fmt: skip
    assert not any("maxForce" in name for name in found["free"])


def test_an_identification_has_configurations_and_a_joint_covariance(tmp_path: Any) -> None:
    (tmp_path / "leg.xml").write_text(MODEL, encoding="utf-8")
    pd = {"q_des": "q_des", "kp": "kp", "kd": "kd", "delay": "profile"}
    logs: list[Any] = []
    for seed in (0, 0, 0):
        case = Case(seed, delay=0.004, disturbance=0.05 + 0.05 * len(logs), seconds=6.0)
        found = case.commands()
        data = {name: getattr(found, name) for name in ("q", "q_des", "kp", "kd")}
        keys = {"joints": list(JOINTS), "rate": RATE, "tau": {"pd": pd}}
        logs.append(sysid_bench.log_of(data, keys))
    for several in (logs[:1], logs):
        result = sysid_bench.identify(tmp_path / "leg.xml", task="actuators", log=several)
        assert isinstance(result, ActuatorsResult)
        assert result.covariance["of"] == [*UNKNOWNS, "delay"]
        for name, joint in result.joints.items():
            C = np.array(result.covariance["joints"][name])
            assert np.linalg.eigvalsh(C).min() > -1e-12 * np.trace(C)
            free = [term for term in UNKNOWNS if term not in joint["at_bound"]]
            std = [joint["std"][term] for term in free]
            places = [UNKNOWNS.index(term) for term in free]
            np.testing.assert_allclose(np.sqrt(np.diag(C))[places], std, rtol=1e-9)
        _, made = read(result.configurations["mjlab"])
        assert [one["armature"] for one in made] == pytest.approx(
            [joint["Ia"] for joint in result.joints.values()], rel=1e-5
        )


def test_a_covariance_between_files_is_that_of_numpy() -> None:
    rng = np.random.default_rng(1)
    values, delays = rng.normal(size=(6, 3, 4)), rng.normal(size=6)
    C = repeat_covariance(values, delays)
    expected = np.cov(np.column_stack([values[:, 1], delays]).T)
    assert_close(C[1], expected)


def test_a_configuration_has_the_limits_of_the_written_model(tmp_path: Any) -> None:
    """A limit in stated torque is as wrong as the stated gains, and is corrected with them."""
    (tmp_path / "leg.xml").write_text(MODEL, encoding="utf-8")
    found = Case(3, delay=0.004, more=(("gain", 1.15),), disturbance=0.03).commands()
    pd = {"q_des": "q_des", "kp": "kp", "kd": "kd", "delay": "4 ms", "limit": 40.0}
    data = {name: getattr(found, name) for name in ("q", "q_des", "kp", "kd")}
    log = sysid_bench.log_of(data, {"joints": list(JOINTS), "rate": RATE, "tau": {"pd": pd}})
    result = sysid_bench.identify(
        *(tmp_path / "leg.xml",), task="actuators", log=log, also=["gain"],
        model_out=tmp_path / "out.xml",
    )  # fmt: skip
    assert isinstance(result, ActuatorsResult)
    _, made = read(result.configurations["mjlab"])
    written = stated_actuators(find_manifest(str(tmp_path / "out.xml")))
    for name, one in zip(JOINTS, made, strict=True):
        assert one["stiffness"] == pytest.approx(written[name].kp, rel=1e-4)
        gain = result.joints[name]["gain"]
        assert gain == pytest.approx(1.15, abs=0.05)
        assert one["effort_limit"] == pytest.approx(40.0 * gain, rel=1e-4)
