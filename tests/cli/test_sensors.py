"""The verbs basis and identify behind a force/torque sensor, and its recording."""

import json

import numpy as np
import pytest

from sysid_bench.errors import UsageError
from sysid_bench.harness.experiment.evidence import evidence
from sysid_bench.verbs import basis as bases
from sysid_bench.verbs.basis import basis
from sysid_bench.verbs.identify import identify, summary
from tests.experiments.experiment_world import argument, executed, spec

from .conftest import Run, one_sentence

NOISE = {"force": "0.15 N", "moment": "0.008 N m"}


def test_basis_tells_what_a_sensor_tells(cli: Run) -> None:
    done = cli("basis", "icub", "--task", "wrench", "--sensor", "l_arm_ft_sensor", "--json")
    assert done.returncode == 0, done.stderr
    told = json.loads(done.stdout)
    assert (told["base_parameters"], told["parameters"]) == (38, 90)
    assert told["rows"][0] == "l_arm_ft_sensor.nx"


def test_a_random_robot_is_cut_anywhere() -> None:
    told = basis("random:3", "wrench", terms=("offset",), free_base=None, sensor="b2")
    assert told["base_parameters"] == told["inertial"] + 6
    assert bases.summary(told)


def test_a_wrong_sensor_is_one_sentence(cli: Run) -> None:
    done = cli("basis", "ur5", "--task", "wrench", "--sensor", "wirst")
    assert done.returncode == 2
    assert "'wrist'" in one_sentence(done)


def test_identify_compares_parameters_and_names_what_is_missing() -> None:
    told = identify("icub", task="wrench", sensor="l_arm", noise=NOISE)
    sensor = told["sensor"]
    assert (sensor["structural_rank"], sensor["excited_rank"]) == (38, 38)
    assert sensor["unpredictable"] == []
    true, cad, found = (sensor["estimation"][k] for k in ("true", "CAD", "identified"))
    assert found["force"] < 1.02 * true["force"]
    assert found["torque"] < 1.1 * true["torque"]
    assert found["torque_alone"] < 0.1 * cad["torque_alone"]
    assert any("sensor l_arm" in line for line in summary(told))
    assert identify("icub", task="wrench", sensor="l_leg")["sensor"]["estimation"] is None


def test_a_payload_comes_as_mass_centre_and_inertia() -> None:
    told = identify("panda", task="wrench-payload", payload="box-2kg", sensor="wrist", noise=NOISE)
    assert told["payload"]["mass"] == pytest.approx(2.0, abs=0.01)
    assert told["estimator"] == "wls"
    assert "sensor" not in told


def test_a_robot_held_before_the_sensor_says_what_it_cannot_know() -> None:
    """A sensor between the world and a robot on its bench: the data tell less than flight would."""
    told = identify("z1", task="wrench", sensor="base_static_joint")
    assert told["sensor"]["excited_rank"] < told["sensor"]["structural_rank"]
    assert any("cannot be foretold" in w or "no torque" in w for w in told["warnings"])


def test_unknown_noise_lists_the_kinds() -> None:
    with pytest.raises(UsageError, match="moment_offset"):
        identify("ur5", task="wrench", sensor="wrist", noise={"forze": "1 N"})


def test_a_recording_shows_torques_and_convergence_on_line() -> None:
    made = spec(robot="icub", task="wrench", sensor="l_arm", noise={"force": 0.15, "moment": 0.008})
    (row,) = executed(made, "wls")
    shown = evidence(argument(made, "wls"), row)
    names = [curve.name for curve in shown.curves]
    assert names[-1] == "relative parameter error"
    assert "torque of l_elbow" in names
    torque, error = shown.curves[0].series, shown.curves[-1].series
    assert set(torque) == {"true", "CAD", "on-line"}
    late = slice(len(shown.curves[0].t) // 2, None)
    wrong = {k: np.linalg.norm(torque[k][late] - torque["true"][late]) for k in torque}
    assert wrong["on-line"] < 0.5 * wrong["CAD"]
    assert error["on-line"][-1] < 0.1 * error["CAD"][-1]
