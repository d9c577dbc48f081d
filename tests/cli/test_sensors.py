"""The commands basis and identify behind a force/torque sensor, and its recording."""

import json
from pathlib import Path

import numpy as np
import pytest

from sysid_bench.commands.basis import basis
from sysid_bench.commands.identify import identify
from sysid_bench.errors import UnsupportedError, UsageError
from sysid_bench.experiments.cell_data import cell_data
from sysid_bench.models.load import load_robot
from sysid_bench.spatial import feasible_margins
from tests.experiments.experiment_world import argument, executed, spec

from .conftest import Run

NOISE = {"force": "0.15 N", "moment": "0.008 N m"}


def test_basis_reports_what_a_sensor_identifies(cli: Run) -> None:
    done = cli("basis", "icub", "--task", "wrench", "--sensor", "l_arm_ft_sensor", "--json")
    assert done.returncode == 0, done.stderr
    result = json.loads(done.stdout)
    assert (result["base_parameters"], result["parameters"]) == (38, 90)
    assert result["rows"][0] == "l_arm_ft_sensor.nx"


def test_a_random_robot_is_cut_anywhere() -> None:
    result = basis("random:3", "wrench", terms=("offset",), free_base=None, sensor="b2")
    assert result["base_parameters"] == result["inertial"] + 6
    assert result.summary()


def test_identify_compares_parameters_and_names_what_is_missing() -> None:
    result = identify("icub", task="wrench", sensor="l_arm", noise=NOISE)
    sensor = result["sensor"]
    assert (sensor["structural_rank"], sensor["excited_rank"]) == (38, 38)
    assert sensor["unpredictable"] == []
    true, cad, found = (sensor["estimation"][k] for k in ("true", "CAD", "identified"))
    assert found["force"] < 1.02 * true["force"]
    assert found["torque"] < 1.1 * true["torque"]
    assert found["torque_alone"] < 0.1 * cad["torque_alone"]
    assert "sensor l_arm" in result.summary()
    assert identify("icub", task="wrench", sensor="l_leg")["sensor"]["estimation"] is None


def test_a_payload_comes_as_mass_centre_and_inertia() -> None:
    result = identify(
        "panda", task="wrench-payload", payload="box-2kg", sensor="wrist", noise=NOISE
    )
    assert result["payload"]["mass"] == pytest.approx(2.0, abs=0.01)
    assert result["estimator"] == "wls"
    assert "sensor" not in result


def test_a_robot_held_before_the_sensor_says_what_it_cannot_know() -> None:
    """Between the world and a robot on its bench a sensor excites less than in flight."""
    result = identify("z1", task="wrench", sensor="base_static_joint")
    assert result["sensor"]["excited_rank"] < result["sensor"]["structural_rank"]
    assert any("unpredictable" in w or "no torque" in w for w in result["warnings"])


def test_unknown_noise_lists_the_kinds() -> None:
    with pytest.raises(UsageError, match="moment_offset"):
        identify("ur5", task="wrench", sensor="wrist", noise={"forze": "1 N"})


def test_a_recording_shows_torques_and_convergence_on_line() -> None:
    made = spec(robot="icub", task="wrench", sensor="l_arm", noise={"force": 0.15, "moment": 0.008})
    (row,) = executed(made, "wls")
    shown = cell_data(argument(made, "wls"), row)
    names = [curve.name for curve in shown.curves]
    assert names[-1] == "relative parameter error"
    assert "torque of l_elbow" in names
    torque, error = shown.curves[0].series, shown.curves[-1].series
    assert set(torque) == {"true", "CAD", "on-line"}
    late = slice(len(shown.curves[0].t) // 2, None)
    wrong = {k: np.linalg.norm(torque[k][late] - torque["true"][late]) for k in torque}
    assert wrong["on-line"] < 0.5 * wrong["CAD"]
    assert error["on-line"][-1] < 0.1 * error["CAD"][-1]


@pytest.mark.parametrize(
    ("robot", "task", "sensor", "payload"),
    [
        ("icub", "wrench", "l_arm", "none"),  # noise carries the light wrist out of what can exist
        ("icub", "wrench", "l_leg", "none"),  # ends at another sensor
        ("ur5", "wrench", "forearm_link", "sphere-1kg"),
        ("z1", "wrench-payload", "wrist", "box-2kg"),
    ],
)
@pytest.mark.parametrize("estimator", ["wls", "lmi"])
def test_whole_bodies_are_completed_behind_a_sensor(
    robot: str, task: str, sensor: str, payload: str, estimator: str
) -> None:
    result = identify(
        robot, task, payload, ("offset",), estimator, NOISE, sensor=sensor, complete="entropic"
    )
    for name, body in result["bodies"].items():
        phi = np.array(list(body["parameters"].values()))
        assert feasible_margins(phi[None])[0] > -1e-12, name
    assert result["feasible"]
    assert result["torque_error"] < 0.05


def test_a_model_with_its_sub_tree_identified_is_written_back(tmp_path: Path) -> None:
    """Every body behind the sensor is one of the unknowns, welded ones too; those before it keep
    their numbers, and the sensor's constants belong to no model."""
    file = tmp_path / "icub.urdf"
    result = identify(
        "icub", "wrench", terms=("offset",), noise=NOISE, sensor="l_arm", complete="entropic",
        model_out=file,
    )  # fmt: skip
    old, new = load_robot("icub"), load_robot(str(file))
    for name in old.body_names:
        before, after = (r.phi[r.body_names.index(name)] for r in (old, new))
        if name in result["bodies"]:
            wanted = list(result["bodies"][name]["parameters"].values())
            np.testing.assert_allclose(after, wanted, rtol=1e-6, atol=1e-9)
        else:
            np.testing.assert_allclose(after, before, rtol=1e-6, atol=1e-9)
    assert new.phi[new.body_names.index("l_hand"), 0] != old.phi[old.body_names.index("l_hand"), 0]


def test_a_payload_behind_a_sensor_is_in_no_model(tmp_path: Path) -> None:
    with pytest.raises(UnsupportedError, match="'wrench-payload' changes nothing"):
        identify("ur5", "wrench-payload", "box-2kg", model_out=tmp_path / "ur5.urdf")


def test_a_sub_tree_without_joints_or_mass_has_no_torques_to_tell() -> None:
    result = identify("ur5", "wrench", sensor="tool0", noise=NOISE)
    assert "true: touch" in result.summary()


def test_contacts_are_found_or_declared_by_words(cli: Run) -> None:
    result = identify(
        "z1", "wrench", sensor="link02", noise=NOISE | {"touch": "5 N"}, contacts="detect"
    )
    assert result["left_out"] == pytest.approx(1 / 3, abs=0.05)
    assert "left out as contacts" in result.summary()
