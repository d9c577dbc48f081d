"""Models from recordings: written, read again in both engines, and as good as the estimate."""

import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner

from sysid_bench.commands.identify import identify
from sysid_bench.commands.identify_recorded import RecordedResult
from sysid_bench.commands.main import main
from sysid_bench.errors import EstimationError, ModelError, UsageError, WriteError
from sysid_bench.models.load import load_robot
from sysid_bench.models.manifest import find_manifest
from sysid_bench.models.model_record import check_name
from sysid_bench.models.robot import RobotModel
from sysid_bench.spatial import feasible_margins
from sysid_bench.words import FINDINGS
from tests.robots import named_robot
from tests.signals.logs import Recorded, recorded, write

TERMS = ("viscous", "coulomb", "offset")

NOISE = 0.02
"""Noise of each torque over its RMS."""

ACCEPTED: dict[str, Any] = {"accept": FINDINGS}
"""Recordings that contradict the model on purpose."""

BIAS = 0.01
"""Relative bias of a payload's mass by the filter."""


def noisy(robot: RobotModel, seed: int) -> Recorded:
    """A recording with friction beyond the model's, a torque offset and noise."""
    log, rng = recorded(robot, seed), np.random.default_rng(seed)
    rms = np.sqrt(np.mean(log.tau**2, axis=0))
    noise = NOISE * rms * rng.normal(size=log.tau.shape)
    return replace(log, tau=log.tau + 0.1 * rms * np.sign(log.v) + 0.05 * rms + noise)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Training and test recordings of a URDF and of an MJCF robot."""
    folder = tmp_path_factory.mktemp("logs")
    for name in ("ur5", "scara"):
        for seed, use in enumerate(("train", "test")):
            write(folder, noisy(named_robot(name), seed), name=f"{name}_{use}")
    return folder


def asked(folder: Path, name: str, **more: Any) -> Any:
    """The result of the two recordings of a robot."""
    train, test = (folder / f"{name}_{use}.toml" for use in ("train", "test"))
    given: dict[str, Any] = {"log": train, "test": test, "terms": TERMS, **more}
    return identify(name, **given)


@pytest.mark.parametrize(("name", "suffix"), [("ur5", "urdf"), ("scara", "xml")])
@pytest.mark.parametrize("estimator", ["wls", "lmi", "entropic"])
def test_a_written_model_predicts_as_the_estimate_does(
    folder: Path, tmp_path: Path, name: str, suffix: str, estimator: str
) -> None:
    target = tmp_path / f"found.{suffix}"
    result = asked(folder, name, estimator=estimator, model_out=target)
    written = result["written"]
    assert written["torque_error"] <= 1.1 * result["torque_error"]
    assert written["gap"] < 1e-12
    again = load_robot(find_manifest(str(tmp_path / "found.toml")))
    assert feasible_margins(again.phi).min() > -1e-9
    # The offset of 5 % has no place in a model file: the manifest beside it holds it.
    assert np.abs(again.joint_terms.offset).min() > 0
    assert "it predicts" in result.summary()
    # A name of its own: suites refuse the one of an installed robot that is another one.
    check_name(again.manifest)
    if suffix == "urdf":
        assert not load_robot(target).joint_terms.offset.any()
        with pytest.raises(UsageError, match=r"the manifest of found\.urdf, and would be"):
            asked(folder, name, estimator=estimator, model_out=target.with_suffix(".xml"))


def test_terms_that_were_not_identified_are_zero_in_the_files(folder: Path, tmp_path: Path) -> None:
    target = tmp_path / "found.xml"
    result = asked(folder, "scara", terms=("coulomb",), model_out=target)
    again = load_robot(find_manifest(str(tmp_path / "found.toml"))).joint_terms
    assert again.coulomb.all()
    for term in ("viscous", "offset", "armature", "spring"):
        assert not getattr(again, term).any(), term
    assert not load_robot(target).joint_terms.viscous.any()
    assert result["written"]["torque_error"] <= 1.1 * result["torque_error"]


def test_a_refused_model_loses_neither_table_nor_json(folder: Path, tmp_path: Path) -> None:
    robot = find_manifest("ur5")
    answer, target = tmp_path / "answer.json", tmp_path / "found.urdf"
    with pytest.raises(WriteError, match="no prior to complete") as refused:
        asked(folder, "ur5", model_out=target, json_out=answer, prior="none")
    assert not target.exists()
    result = refused.value.result
    assert isinstance(result, RecordedResult)
    assert result.torque_error == json.loads(answer.read_text())["torque_error"]
    assert result.model_out is None
    logs = [str(folder / "ur5_train.toml"), "--test", str(folder / "ur5_test.toml")]
    options = ["--model-out", str(target), "--prior", "none"]
    answered = CliRunner().invoke(main, ["identify", str(robot.name), "--log", *logs, *options])
    assert answered.exit_code == 2
    assert "wrist_3_joint" in answered.stdout
    assert "--estimator lmi" in answered.stderr
    # What the message advises works.
    written = asked(folder, "ur5", model_out=target, prior="none", estimator="lmi")["written"]
    assert written["completed"] is None
    assert target.exists()


def test_placeholders_are_not_believed_unless_their_spreads_are_stated(
    folder: Path, tmp_path: Path
) -> None:
    """The same file with 2 kg and 0.01 kg m^2 on every link."""
    robot = named_robot("ur5")
    inertia = '<inertia ixx="0.01" ixy="0" ixz="0" iyy="0.01" iyz="0" izz="0.01"/>'
    text = robot.text.decode()
    text = re.sub(r'<mass value="[^"]*"', '<mass value="2"', text)
    text = re.sub(r"<inertia [^>]*/>", inertia, text)
    same = tmp_path / "same.urdf"
    same.write_text(text)
    logs: dict[str, Any] = {"log": folder / "ur5_train.toml", "test": folder / "ur5_test.toml"}
    result = identify(same, **logs)
    assert "placeholders" in result["prior"]["reason"]
    assert "  no prior: the inertias of the model file are placeholders" in result.summary()
    with pytest.raises(EstimationError, match="placeholders"):
        identify(same, estimator="entropic", **logs)
    insisted = identify(same, estimator="entropic", prior={"mass": "50 %"}, **logs)
    assert insisted["prior"]["spreads"].startswith("mass 50 %")
    assert "the model file's links, mass 50 %" in insisted.summary()


def test_a_prior_serves_where_the_motion_does_not(folder: Path, tmp_path: Path) -> None:
    """A motion of a second excites little: the prior improves the prediction of another motion."""
    log = noisy(named_robot("ur5"), 5)
    part = Recorded(log.joints, log.t[:150], log.q[:150], log.v[:150], log.tau[:150])
    path = write(tmp_path, part, name="part")
    errors = {
        estimator: identify("ur5", log=path, test=folder / "ur5_test.toml", estimator=estimator)
        for estimator in ("wls", "a-priori")
    }
    assert errors["a-priori"]["torque_error"] < errors["wls"]["torque_error"]


@pytest.mark.long
@pytest.mark.parametrize("joint", [0, 2, 5])
def test_a_negative_friction_binds_and_its_cost_is_reported(
    folder: Path, tmp_path: Path, joint: int
) -> None:
    log, test = (noisy(named_robot("ur5"), seed) for seed in (0, 1))
    shift = np.eye(6)[joint]
    pushed = [
        replace(one, tau=one.tau - (4 + 0.2 * np.abs(one.tau).max(axis=0)) * shift * one.v)
        for one in (log, test)
    ]
    paths = [write(tmp_path, one, name=f"run{k}") for k, one in enumerate(pushed)]
    result = identify("ur5", log=paths[0], test=paths[1], estimator="lmi", **ACCEPTED)
    first = result["constraints"][0]
    assert first["constraint"] == f"{log.joints[joint]}.fv"
    assert first["cost"] > 0.1
    bodies: dict[str, Any] = {"estimator": "lmi", "feasible": "bodies", **ACCEPTED}
    free = identify("ur5", log=paths[0], test=paths[1], **bodies)
    assert free["torque_error"] < result["torque_error"] - 0.1
    with pytest.raises((WriteError, ModelError), match="negative"):
        identify("ur5", log=paths[0], model_out=tmp_path / "x.urdf", **bodies)


def test_features_take_the_place_of_joint_terms(folder: Path, tmp_path: Path) -> None:
    plain = asked(folder, "scara", terms=("viscous", "offset"))
    smooth = asked(folder, "scara", terms=("viscous", "tanh", "offset"))
    assert smooth["torque_error"] < 0.5 * plain["torque_error"]
    row = named_robot("scara").rows[0]
    one = asked(folder, "scara", terms=("viscous", "offset", f"{row}.tanh"))
    assert set(one["joints"][row]) - set(plain["joints"][row]) == {"tanh20"}
    others = [name for name in one["joints"] if name != row]
    assert all(set(one["joints"][name]) == set(plain["joints"][name]) for name in others)
    written = asked(folder, "scara", terms=("viscous", f"{row}.tanh"), model_out=tmp_path / "m.xml")
    assert written["written"]["left_out"] == [f"{row}.tanh20"]
    with pytest.raises(UsageError, match="tanh"):
        asked(folder, "scara", terms=("tanhh",))


def test_a_column_of_ones_own_comes_from_the_manifest(folder: Path, tmp_path: Path) -> None:
    """A counterbalance on one joint, as a plug-in beside robot.toml."""
    robot = named_robot("scara")
    joint = robot.rows[1]
    (tmp_path / "mine.py").write_text(
        "import numpy as np\n\n\nclass Counterbalance:\n    suffixes = ('spring',)\n\n"
        "    def values(self, q, v, reach):\n        return np.sin(q)[:, None]\n"
    )
    (tmp_path / "robot.toml").write_text(
        f'name = "own"\nfile = "{robot.manifest.path.resolve()}"\n'
        f'terms = ["viscous", "coulomb", "offset", "{joint}.file:mine.py:Counterbalance"]\n'
    )
    log = noisy(robot, 0)
    sprung = replace(log, tau=log.tau + 7.0 * np.eye(4)[1] * np.sin(log.q))
    path = write(tmp_path, sprung)
    result = identify(tmp_path / "robot.toml", log=path, **ACCEPTED)
    found = result["joints"][joint]["spring"]
    assert found["value"] == pytest.approx(7.0, abs=5 * found["std"])
    assert found["std"] < 0.7


@pytest.mark.long
@pytest.mark.parametrize("joint", [2, 3, 4])
def test_a_wrong_gain_is_found_by_a_known_load(tmp_path: Path, joint: int) -> None:
    unloaded, loaded = recorded(named_robot("ur5"), 3), recorded(named_robot("ur5", "box-2kg"), 4)
    gains = np.ones(6)
    gains[joint] = 1.7
    logs = [
        write(tmp_path, replace(unloaded, tau=gains * unloaded.tau), name="a"),
        write(tmp_path, replace(loaded, tau=gains * loaded.tau), name="b", payload="box-2kg"),
    ]
    result = identify("ur5", task="payload", log=logs, position_given=True)
    sentence = next(line for line in result["warnings"] if "divide the gains" in line)
    ((name, factor),) = re.findall(r"(\w+) ([0-9.]+) ±", sentence)
    assert name == unloaded.joints[joint]
    assert float(factor) == pytest.approx(1.7, rel=0.1)
    right = [
        write(tmp_path, unloaded, name="c"),
        write(tmp_path, loaded, name="d", payload="box-2kg"),
    ]
    result = identify("ur5", task="payload", log=right, position_given=True)
    assert not any("gains" in line for line in result["warnings"])
    low, high = result["payload"]["interval"]
    # The filter takes some of the load's torque: the interval does not know of that bias.
    assert low <= 2.0 * (1 + BIAS)
    assert high >= 2.0 * (1 - BIAS)


@pytest.mark.parametrize("option", [{"prior": "none"}, {"prior": "model"}, {"feasible": "bodies"}])
def test_options_of_recordings_are_refused_for_simulations(option: dict[str, str]) -> None:
    with pytest.raises(UsageError, match=f"--{next(iter(option))}: for recordings only"):
        identify("scara", simulate=True, **option)  # type: ignore[arg-type]
