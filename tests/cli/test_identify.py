"""The commands basis and identify: fields of the contract, honest numbers, models out."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sysid_bench import IdentifyResult, package_folders
from sysid_bench.commands.basis import basis
from sysid_bench.commands.identify import identify
from sysid_bench.commands.values import parse_noise, parse_payload, parse_terms
from sysid_bench.errors import ModelError, UnsupportedError, UsageError
from sysid_bench.evaluation.intervals import at_level
from sysid_bench.experiments.tasks.task import unknown_bodies
from sysid_bench.harness.run import run
from sysid_bench.identifiability.base_map import structural_base
from sysid_bench.models.load import load_robot
from sysid_bench.models.payload import PAYLOADS
from sysid_bench.spatial import NAMES
from tests.robots import NAMED, named_robot
from tests.signals.logs import recorded, write, write_two

from .conftest import Run

BASIS = {
    "robot", "task", "terms", "parameters", "base_parameters", "inertial", "gap",
    "near_degenerate", "dropped_torque", "combinations", "verdicts",
}  # fmt: skip
ANSWER = {
    "model", "task", "estimator", "rank", "parameters", "condition", "rmse_train", "rmse_test",
    "torque_error", "bodies", "joints", "payload", "feasible", "warnings",
}  # fmt: skip
BODY = {"mass", "com", "inertia", "identifiable", "std"}


def test_basis_prints_the_fields_of_the_contract(cli: Run) -> None:
    done = cli("basis", "ur5", "--json")
    assert done.returncode == 0, done.stderr
    result = json.loads(done.stdout)
    assert set(result) >= BASIS
    assert (result["base_parameters"], result["inertial"]) == (48, 36)
    assert result["parameters"] == len(result["verdicts"]) == 112
    assert len(result["combinations"]) == 48
    assert set(result["combinations"][0]) == {"expression", "terms"}
    assert set(result["verdicts"].values()) == {"identifiable", "combination", "none"}


def test_basis_prints_sums_single_ones_first(cli: Run) -> None:
    done = cli("basis", "ur5", "--task", "terminal", "--terms", "viscous,coulomb", "--paper")
    lines = done.stdout.splitlines()
    assert len(lines) == 9
    assert lines[-1] == "wrist_3_link.Ixx - wrist_3_link.Izz"
    assert all(" " not in line for line in lines[:-1])


@pytest.mark.parametrize("name", NAMED)
def test_basis_agrees_with_the_base_map(name: str) -> None:
    result = basis(name, terms=())
    robot = named_robot(name)
    columns = [column for body in unknown_bodies(robot) for column in body.columns]
    base = structural_base(robot, tuple(columns))
    assert result["base_parameters"] == result["inertial"] == base.rank
    assert [next(iter(entry["terms"])) for entry in result["combinations"]] == list(base.names)
    assert sorted(result.expressions()) == sorted(
        entry["expression"] for entry in result["combinations"]
    )
    assert str(base.rank) in result.summary().splitlines()[0]


@pytest.mark.parametrize(
    ("task", "rank"), [("terminal", 7), ("link", 10), ("payload", 10), ("robot", 36)]
)
def test_basis_of_every_task(task: str, rank: int) -> None:
    result = basis("ur5", task, terms=())
    assert result["base_parameters"] == rank
    alone = {entry["expression"] for entry in result["combinations"] if len(entry["terms"]) == 1}
    assert alone == {name for name, v in result["verdicts"].items() if v == "identifiable"}


@pytest.mark.parametrize("file", ["so100.urdf", "so101.urdf"])
def test_near_degenerate_directions_are_named(file: str) -> None:
    (path,) = package_folders.robot_data_folder().rglob(file)
    result = basis(path)
    assert (result["base_parameters"], result["near_degenerate"]) == (36, 2)
    directions = result["near_degenerate_directions"]
    assert len(directions) == 2
    for entry in directions:
        assert set(entry["terms"]) <= set(result["verdicts"])
        assert entry["expression"] in result.summary()


def test_identify_prints_the_fields_of_the_contract(cli: Run) -> None:
    words = ("--simulate", "--task", "terminal", "--payload", "box-2kg")
    done = cli("identify", "ur5", *words, "--terms", "viscous,coulomb", "--json")
    assert done.returncode == 0, done.stderr
    result = json.loads(done.stdout)
    assert set(result) >= ANSWER
    assert (result["estimator"], result["rank"], result["parameters"]) == ("min-norm", 9, 12)
    body = result["bodies"]["wrist_3_link"]
    assert set(body) >= BODY
    assert body["mass"] is None
    assert body["identifiable"]["m"] == "none"
    assert tuple(body["parameters"]) == NAMES
    assert result["rmse_test"] < 1e-9
    assert "wrist_3_link.m" in result["warnings"][-1]
    assert result["joints"]["wrist_3_joint"]["viscous"]["value"] == pytest.approx(1.0)


SUITE = """
schema = 1
name = "same"
seed = 0
[defaults]
noise = { tau = "1 %" }
[[robot]]
use = "scara"
[[log]]
robot = "ur5"
train = ["run.toml"]
test = ["other.toml"]
[[estimator]]
use = "wls"
"""


def test_an_answer_is_the_row_of_a_cell_with_defaults(tmp_path: Path) -> None:
    write_two(tmp_path)
    (tmp_path / "same.toml").write_text(SUITE)
    rows = run(tmp_path / "same.toml", tmp_path / "out", jobs=1).folder.rows().rows.values()
    answers = {
        "scara": identify("scara", estimator="wls", noise={"tau": "1 %"}),
        "ur5": identify("ur5", log=tmp_path / "run.toml", test=tmp_path / "other.toml"),
    }
    assert {row["robot"] for row in rows} == set(answers)
    for row in rows:
        assert row["status"] == "ok"
        for name, value in answers[row["robot"]].scores.items():
            assert value == row[name], (row["robot"], name)


@pytest.mark.parametrize("name", ["ur5", "panda", "z1", "kinova"])
@pytest.mark.parametrize("payload", ["box-2kg", "none"])
def test_a_link_is_written_with_its_load_and_moves_as_the_loaded_robot(
    name: str, payload: str, tmp_path: Path
) -> None:
    target = tmp_path / "new.urdf"
    result = identify(name, "link", payload, model_out=target)
    assert result["rank"] == 10
    (body,) = result["bodies"].values()
    loaded = named_robot(name, payload)
    again = load_robot(target)
    link = int(loaded.tree.carrier[loaded.tool_body])
    wanted = loaded.tree.link_parameters(loaded.phi)
    scale = np.abs(wanted[link]).max()
    np.testing.assert_allclose(
        again.tree.link_parameters(again.phi), wanted, rtol=0, atol=1e-9 * scale
    )
    assert body["mass"] == pytest.approx(wanted[link][0], abs=1e-9)
    if payload == "none":
        np.testing.assert_allclose(again.phi, loaded.phi, rtol=0, atol=1e-9 * scale)


@pytest.mark.data
def test_an_mjcf_is_written_with_its_load(data_folder: Path, tmp_path: Path) -> None:
    for name in ("unitree_z1__z1", "franka_fr3__fr3", "ufactory_lite6__lite6"):
        source, target = data_folder / "robots" / f"{name}.xml", tmp_path / f"{name}.xml"
        identify(source, "link", "box-2kg", model_out=target)
        loaded, again = load_robot(source, PAYLOADS["box-2kg"]), load_robot(target)
        np.testing.assert_allclose(
            again.tree.link_parameters(again.phi),
            loaded.tree.link_parameters(loaded.phi),
            atol=1e-9,
        )


def test_a_body_that_moves_freely_is_written_whole_with_its_friction(tmp_path: Path) -> None:
    source, target = tmp_path / "in.xml", tmp_path / "out.xml"
    source.write_text(
        '<mujoco><worldbody><body name="base"><freejoint/><inertial pos=".1 0 0" mass="3" '
        'diaginertia=".1 .2 .25"/></body></worldbody></mujoco>'
    )
    result = identify(source, "robot", "none", terms=(), model_out=target)
    assert result["rank"] == result["parameters"] == 10
    assert result["feasible"]
    np.testing.assert_allclose(load_robot(target).phi, load_robot(source).phi, atol=1e-9)


def test_noise_has_a_spread_and_its_seed_a_draw() -> None:
    def once(seed: int) -> IdentifyResult:
        return identify("ur5", "link", "box-2kg", noise={"tau": "1 %"}, seed=seed)

    one, again, other = once(1), once(1), once(2)
    assert one == again
    (body,), (different,) = one["bodies"].values(), other["bodies"].values()
    assert body["mass"] != different["mass"]
    truth = named_robot("ur5", "box-2kg")
    link = int(truth.tree.carrier[truth.tool_body])
    for result in (body, different):
        error = abs(result["mass"] - truth.tree.link_parameters(truth.phi)[link][0])
        assert 0 < error < 5 * result["std"]["m"]


@pytest.mark.parametrize("name", ["ur5", "panda"])
def test_least_squares_says_nothing_about_what_it_cannot_identify(name: str) -> None:
    result = identify(name, "robot", terms=("viscous",))
    for body in result["bodies"].values():
        for key, verdict in body["identifiable"].items():
            known = verdict == "identifiable"
            assert (body["parameters"][key] is not None) == known
            assert (body["std"][key] is not None) == known
    assert result["feasible"] is None


def test_targets_are_refused_before_anything_runs(tmp_path: Path) -> None:
    source = named_robot("ur5").manifest.path
    for target, task, error in (
        (tmp_path / "a.txt", "link", UsageError),
        (tmp_path / "nowhere" / "a.urdf", "link", UsageError),
        (source, "link", UsageError),
        (tmp_path / "a.urdf", "payload", UnsupportedError),
    ):
        with pytest.raises(error):
            identify("ur5", task, "box-2kg", model_out=target)
    with pytest.raises(ModelError, match="were not identified"):
        identify("ur5", "robot", model_out=tmp_path / "a.urdf")


def test_a_payload_may_be_a_table(cli: Run) -> None:
    table = '{ mass = 1.2, com = [0, 0, 0.05], inertia = "sphere 0.05 m" }'
    done = cli(
        "identify", "ur5", "--simulate", "--task", "payload", "--payload", table, "--free-base",
        "--json",
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    result = json.loads(done.stdout)
    assert result["payload"]["mass"] == pytest.approx(1.2, abs=1e-9)
    assert result["torque_error"] < 1e-9
    assert "root.wz" in result["rows"]


@pytest.mark.parametrize("task", ["payload"])
@pytest.mark.parametrize("terms", [("viscous",), ("armature", "spring")])
def test_terms_that_a_task_takes_as_known_are_refused(task: str, terms: tuple[str, ...]) -> None:
    with pytest.raises(UsageError, match=f"{terms[0]}.* cannot be identified"):
        basis("ur5", task, terms)
    with pytest.raises(UsageError, match=f"{terms[0]}.* cannot be identified"):
        identify("ur5", task, "box-2kg", terms)


@pytest.mark.parametrize(("name", "task"), [("ur5", "robot"), ("z1", "terminal"), ("z1", "link")])
def test_the_terms_that_were_estimated_are_reported(name: str, task: str) -> None:
    result = identify(name, task)
    own = named_robot(name).manifest.terms if task == "robot" else ()
    assert tuple(result["terms"]) == own
    for terms in result["joints"].values():
        assert tuple(terms) == own
    assert bool(result["joints"]) == bool(own)


def test_a_joint_term_that_is_no_single_number_is_not_printed_as_one(tmp_path: Path) -> None:
    """An armature beside the inertia about the same axis: their sum alone acts."""
    file = tmp_path / "arm.xml"
    file.write_text(
        '<mujoco><worldbody><body name="a"><joint name="j1" axis="0 0 1" armature=".1"/>'
        '<geom size=".1"/><body name="b" pos="1 0 0"><joint name="j2" axis="0 1 0" damping="2"/>'
        '<geom size=".1"/></body></body></worldbody></mujoco>'
    )
    result = identify(file, terms=("armature", "viscous"), estimator="min-norm")
    lines = result.summary()
    assert result["joints"]["j1"]["armature"]["identifiable"] == "combination"
    assert "j1: armature not identifiable, viscous " in lines
    assert "j2: armature not identifiable, viscous 2" in lines


def test_an_answer_never_replaces_its_model(tmp_path: Path) -> None:
    source = tmp_path / "arm.urdf"
    source.write_bytes(named_robot("ur5").manifest.path.read_bytes())
    before = source.read_bytes()
    link = tmp_path / "same.json"
    link.symlink_to(source)
    twin = tmp_path / "twin.json"
    twin.hardlink_to(source)
    for target in (source, link, twin):
        with pytest.raises(UsageError, match="is the model itself"):
            identify(source, "link", json_out=target)
    manifest = tmp_path / "robot.toml"
    manifest.write_text('name = "mine"\nfile = "arm.urdf"\n')
    with pytest.raises(UsageError, match="is the model itself"):
        identify(manifest, "link", json_out=manifest)
    new = tmp_path / "new.urdf"
    with pytest.raises(UsageError, match="two files"):
        identify(source, "link", model_out=new, json_out=new)
    with pytest.raises(UsageError, match=r"folder .* does not exist"):
        identify(source, "link", json_out=tmp_path / "nowhere" / "a.json")
    assert source.read_bytes() == before
    assert not new.exists()


@pytest.mark.parametrize(
    ("option", "name"),
    [
        ("model_out", "run.urdf"),  # its joint terms go to run.toml, the description of the log
        ("json_out", "run.csv"),
        ("json_out", "run.toml"),
        ("figure", "other.csv"),
        ("model_out", "suite.urdf"),
    ],
)
def test_an_answer_never_replaces_a_recording_or_a_file_of_another_kind(
    tmp_path: Path, option: str, name: str
) -> None:
    log = recorded(named_robot("ur5"))
    train, test = write(tmp_path, log), write(tmp_path, log, name="other")
    (tmp_path / "suite.toml").write_text('schema = 1\nname = "mine"\n')
    before = {file: file.read_bytes() for file in tmp_path.iterdir()}
    outputs: dict[str, Any] = {option: tmp_path / name}
    with pytest.raises(UsageError, match="would be overwritten"):
        identify("ur5", log=train, test=test, **outputs)
    assert {file: file.read_bytes() for file in tmp_path.iterdir()} == before


@pytest.mark.parametrize("name", ["random:3", "random:12"])
def test_a_random_robot_is_written_from_its_own_text(name: str, tmp_path: Path) -> None:
    target = tmp_path / "new.xml"
    result = identify(name, "link", model_out=target)
    assert result["rank"] == 10
    robot, again = load_robot(name), load_robot(target)
    np.testing.assert_allclose(
        again.tree.link_parameters(again.phi),
        robot.tree.link_parameters(robot.phi),
        rtol=0,
        atol=1e-9,
    )


def test_words_of_options() -> None:
    assert parse_terms(None) is None
    assert parse_terms("none") == parse_terms("") == ()
    assert parse_terms("viscous, coulomb") == ("viscous", "coulomb")
    assert parse_noise(None) == {}
    assert parse_noise("tau=0.5 %, q=1e-4 rad") == {"tau": "0.5 %", "q": "1e-4 rad"}
    assert parse_payload("box-2kg") == "box-2kg"
    assert parse_payload(" { mass = 1, com = [0, 0, 1] }") == {"mass": 1, "com": [0, 0, 1]}


@pytest.mark.parametrize("distance", ["entropic", "euclidean", "pullback"])
@pytest.mark.parametrize("name", ["ur5", "z1", "solo12"])
def test_completed_bodies_are_written_with_the_torques_that_were_identified(
    name: str, distance: str, tmp_path: Path
) -> None:
    """No torques identify all masses: completed ones leave every torque as it was."""
    out = tmp_path / "out.urdf"
    answer = identify(name, terms=(), model_out=out, complete=distance)
    assert answer["completed"] == distance
    assert answer["feasible"]
    written, robot = load_robot(out), named_robot(name)
    base = structural_base(robot, robot.inertial_columns)
    # Compared by name: the file has the robot's own bodies, in its own order.
    mine = dict(zip(written.inertial_columns, written.phi.ravel(), strict=True))
    phi = np.array([mine[column] for column in robot.inertial_columns])
    beta, truth = base.K @ phi, base.K @ robot.phi.ravel()
    assert np.linalg.norm(beta - truth) <= 1e-6 * np.linalg.norm(truth)


def test_what_noise_has_made_impossible_is_moved_as_little_as_it_takes() -> None:
    """Least squares alone would not exist; what does is reported, and what it costs."""
    plain, whole = (
        identify("z1", noise={"tau": "20 %"}, complete=distance) for distance in (None, "entropic")
    )
    assert whole["feasible"]
    (warning,) = (text for text in whole["warnings"] if "no feasible bodies" in text)
    assert 0 < float(warning.split(" reported, ")[1].split(" more ")[0]) < 10 * whole["rank"]
    assert whole["rmse_test"] < 2 * plain["rmse_test"]


@pytest.mark.parametrize(
    ("estimator", "kind"), [("ols", "residuals"), ("huber", "textbook"), ("bounded", "blocks")]
)
def test_deviations_are_reported_with_where_they_come_from(
    estimator: str, kind: str | None
) -> None:
    result = identify("scara", estimator=estimator, noise={"tau": "1 %"})
    assert result["std_from"] == kind
    stds = [entry["std"] for entry in result["base"]]
    stds += [term["std"] for joint in result["joints"].values() for term in joint.values()]
    assert all(std is None or std > 0 for std in stds)
    assert all((entry["std"] is None) == (kind is None) for entry in result["base"])
    lines = result.summary()
    assert ("±" in lines) == (kind is not None)


@pytest.mark.parametrize("robot", ["so100", "ur5", "scara", "dvrk_psm"])
def test_what_the_rank_rule_drops_is_said_and_is_the_error_of_exact_data(robot: str) -> None:
    """Exact data are answered to 1e-9, or the reason is printed."""
    result = identify(robot)
    rule = [text for text in result.warnings if text.startswith("the rank rule drops")]
    reason = [text for text in result.warnings if text.startswith("the data are exact, and")]
    assert bool(rule) == (result.near_degenerate > 0)
    assert bool(reason) == (result.torque_error > 1e-9)
    for text in rule:
        assert f"gap {result.rank_gap:.3g}" in text
        assert "e-06 of the whole" in text
    for text in reason:
        assert "the rank rule drops" in text


def test_a_result_replaces_results_alone(tmp_path: Path) -> None:
    target = tmp_path / "answer.json"
    for _ in range(2):
        identify("scara", json_out=target)
    assert json.loads(target.read_text())["model"] == "scara"
    target.write_text('{"mine": 1}')
    with pytest.raises(UsageError, match="would be lost"):
        identify("scara", json_out=target)
    assert target.read_text() == '{"mine": 1}'


def test_deviations_of_the_text_have_the_stated_level() -> None:
    words: dict[str, Any] = {"noise": {"tau": "1 %"}}
    plain = identify("scara", **words)
    with at_level(0.99):
        stated = identify("scara", **words)
        assert "99 % interval" in stated.summary()
    assert "one standard deviation" in plain.summary()
    assert "reach" not in plain
    assert stated["reach"] == pytest.approx(2.576, rel=0.05)
    assert stated["base"] == plain["base"]  # the JSON keeps deviations


def test_friction_below_zero_within_its_deviation_is_written_as_its_bound(tmp_path: Path) -> None:
    """No Coulomb friction: noise makes about half of the estimates negative."""
    file = tmp_path / "arm.toml"
    file.write_text(
        'name = "arm"\nfile = "example-robot-data:ur_description/urdf/ur5_robot.urdf"\n'
        "[joints.all]\nviscous = 1.0\ncoulomb = 0.0\n"
    )
    words: dict[str, Any] = {"task": "link", "terms": ("viscous", "coulomb"), "payload": "box-2kg"}
    target = tmp_path / "out.urdf"
    result = identify(file, noise={"tau": "0.1 %"}, model_out=target, **words)
    robot = load_robot(target)
    values = {name: terms["coulomb"]["value"] for name, terms in result["joints"].items()}
    for name, value in values.items():
        written = robot.joint_terms.coulomb[robot.rows.index(name)]
        assert written == pytest.approx(max(value, 0.0), abs=1e-12)
        shown = any(f"{name}.fc" in text for text in result["warnings"] if "bound of" in text)
        assert shown == (value < 0)
    assert min(values.values()) < 0 < max(values.values())
