"""Composed plants: sizes from ranges, one truth for all parts, and rows that zero leaves alone."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from sysid_bench.errors import UsageError
from sysid_bench.experiments.simulated.composed_plant import composed_plant, plant_name
from sysid_bench.harness.plan import cells_of_suite
from sysid_bench.harness.suite.load_suite import parse_suite
from sysid_bench.harness.suite.names import static_names
from sysid_bench.plugin_names import BUILTIN, resolve
from sysid_bench.simulation.size import SLIDE
from sysid_bench.types import Row
from tests.closeness import assert_close
from tests.experiments.experiment_world import (
    CLOSED_LOOP,
    executed,
    ready,
    spec,
)
from tests.robots import named_robot

NOISE = {"q": 1e-5, "quantum": 2e-5, "tau_relative": 0.01}
MEASURED = {"filter": "butter 4 10 Hz zero-phase", "derivatives": "from q"}
TIMES = ("seconds", "load", "memory")


def composed(**lists: list[Any]) -> dict[str, Any]:
    return {"use": "composed", **lists}


def kinematics(low: str = "0.5 mm", high: str = "2 mm") -> dict[str, Any]:
    return {"use": "kinematics", "position": {"from": low, "to": high}, "rotation": 0}


def values(**changes: Any) -> list[Row]:
    """The drawn sizes of an experiment."""
    return [dict(row) for row in ready(held_out=(), **changes).source.built.values]


def without(kind: str) -> list[dict[str, Any]]:
    """Every built-in error of a kind, with its sizes at zero."""
    return [{"use": name, **dict.fromkeys(resolve(kind, name).sizes, 0)} for name in BUILTIN[kind]]


def lasting(row: Row) -> Row:
    return {key: x for key, x in row.items() if not any(word in key for word in TIMES)}


@pytest.mark.parametrize(
    ("robot", "simulation"), [("ur5", CLOSED_LOOP), ("random:mimic-gripper:1", {"use": "inverse"})]
)
def test_errors_of_size_zero_leave_the_row_as_it_is(robot: str, simulation: Any) -> None:
    zero = composed(errors=without("model_error"), sensors=without("sensor_error"))
    made = spec(
        robot=robot, simulation=simulation, noise=NOISE, signals=MEASURED, payload="box-2kg"
    )
    (bare,), (row,) = executed(made, "wls"), executed(replace(made, plant=zero), "wls")
    assert bare["status"] == "ok"
    labels = {"experiment": bare["experiment"]}
    assert lasting(row | labels) == lasting(bare)


def test_the_truth_and_the_motions_are_those_of_the_model() -> None:
    plants = [composed(), composed(errors=["kinematics", "base-tilt", "gear-ratio"])]
    exact, other = (ready(plant=plant, simulation=CLOSED_LOOP) for plant in plants)
    np.testing.assert_array_equal(exact.source.truth.theta, other.source.truth.theta)
    assert other.robot is exact.robot
    commanded = [one.experiment.raw.commanded for one in (exact, other)]
    assert commanded[0] is not None
    assert commanded[1] is not None
    np.testing.assert_array_equal(commanded[0].q, commanded[1].q)
    # Held-out motions are carried out by the plant, and read by the model.
    assert len(exact.held_out) == len(other.held_out) > 0
    for name, problem in exact.held_out.items():
        # To model joints from plant joints from model joints: rounding is left.
        np.testing.assert_allclose(problem.W, other.held_out[name].W, atol=1e-12)
        assert np.abs(problem.b - other.held_out[name].b).max() > 1e-3


def test_a_row_holds_the_sizes_that_were_drawn() -> None:
    plant = composed(
        errors=[kinematics(), {"use": "base-tilt", "angle": {"from": "0.1 deg", "to": "0.5 deg"}}],
        sensors=[{"use": "torque-gain", "gain": {"from": "-5 %", "to": "-2 %"}}],
    )
    (row,) = executed(spec(plant=plant), "wls")
    drawn = {(entry["use"], entry["setting"]): entry["drawn"] for entry in row["plant_values"]}
    assert drawn.keys() == {
        *(("kinematics", "position"), ("base-tilt", "angle"), ("torque-gain", "gain"))
    }
    assert len(drawn["kinematics", "position"]) == len(drawn["torque-gain", "gain"]) == 6
    assert all(0.0005 <= x <= 0.002 for x in drawn["kinematics", "position"].values())
    assert all(-0.05 <= x <= -0.02 for x in drawn["torque-gain", "gain"].values())
    assert 0.1 <= np.degrees(drawn["base-tilt", "angle"]) <= 0.5
    # The readings have the gains that the row states.
    exact = ready().experiment.raw.tau
    read = ready(plant=composed(sensors=plant["sensors"])).experiment.raw.tau
    gain = 1.0 + np.array(list(drawn["torque-gain", "gain"].values()))
    assert_close(read, gain * exact, 1e-12)


@pytest.mark.parametrize("change", [
    {"payload": "sphere-1kg"}, {"noise": NOISE}, {"repeat": 3}, {"simulation": CLOSED_LOOP},
    {"excitation": {"use": "ptp"}}, {"plant": composed(errors=["base-tilt", kinematics()])},
], ids=str)  # fmt: skip
def test_a_size_depends_on_the_robot_and_its_own_entry_alone(change: dict[str, Any]) -> None:
    plant = composed(errors=[kinematics()])
    assert values(**{"plant": plant, **change}) == values(plant=plant)


@pytest.mark.parametrize("change", [{"seed": 2}, {"robot": "file:arm.xml"},
                                    {"repeat": 1, "redrawn": ("plant",)}], ids=str)  # fmt: skip
def test_another_robot_seed_or_redrawn_repeat_draws_other_sizes(change: dict[str, Any]) -> None:
    plant = composed(errors=[kinematics()])
    redrawn = {"redrawn": change["redrawn"]} if "redrawn" in change else {}
    assert values(plant=plant, **change) != values(plant=plant, **redrawn)


def test_wider_ranges_scale_the_same_draws_and_a_second_entry_has_its_own() -> None:
    once = values(plant=composed(errors=[kinematics("0 mm", "1 mm")]))[0]["drawn"]
    both = values(plant=composed(errors=[kinematics("0 mm", "2 mm")] * 2))
    first, second = (np.array(list(row["drawn"].values())) for row in both)
    assert_close(first, 2.0 * np.array(list(once.values())), 1e-12)
    assert (first != second).all()


def test_every_recording_of_an_experiment_is_of_one_plant() -> None:
    plant = composed(errors=["base-tilt", "gear-ratio"], sensors=["torque-gain"])
    made = {"task": "payload", "payload": "box-2kg", "signals": {**spec().signals, "runs": "AB"}}
    exact, other = (ready(**made, plant=p) for p in (composed(), plant))
    for here, there in zip(exact.experiment.runs, other.experiment.runs, strict=True):
        assert np.abs(here.recording.tau - there.recording.tau).max() > 1e-3
    # Without the payload the plant's robot has the errors that it has with it.
    bare = ready(plant=plant).experiment.recording
    unloaded = next(run for run in other.experiment.runs if not run.loaded)
    np.testing.assert_array_equal(unloaded.recording.tau, bare.tau)


# --- In a suite ---------------------------------------------------------------------------------

SUITE = """
schema = 1
name = "composed"
defaults.plant = {plant}
run.repeats = 2
robot = [{{ use = "ur5" }}]
estimator = [{{ use = "ols" }}]
"""


def suite(plant: str, **options: Any) -> Any:
    return parse_suite(SUITE.format(plant=plant), **options)


@pytest.mark.parametrize(("plant", "message"), [
    ('{ use = "composed", error = [] }', "'error'. Did you mean 'errors'"),
    ('{ use = "composed", errors = "kinematics" }', "errors of a plant is a list"),
    ('{ use = "composed", errors = [{ position = 1 }] }', "needs a name"),
    ('{ use = "composed", errors = ["kinematic"] }', "called 'kinematic'.*'kinematics'"),
    ('{ use = "composed", sensors = ["delays"] }', "sensor-error is called 'delays'.*'delay'"),
    ('{ use = "composed", effects = ["stribek"] }', "plant is called 'stribek'.*'stribeck'"),
    ('{ use = "composed", effects = ["composed"] }', "no composed plants"),
    ('{ use = "composed", sensors = [{ use = "delay", q = "1 rad" }] }', "delay', q: .*unit 'rad'"),
    ('{ use = "composed", sensors = [{ use = "delay", tua = 1 }] }', "Did you mean 'tau'"),
    ('{ use = "composed", sensors = [{ use = "delay", q = { from = 1 } }] }', "'from' and 'to'"),
    ('{ use = "composed", sensors = [{ use = "delay", q = { from = -1, to = 1 } }] }', "0 or more"),
    ('{ use = "composed", sensors = [{ use = "delay", q = { from = 2, to = 1 } }] }', "ends below"),
])  # fmt: skip
@pytest.mark.parametrize("code", [True, False], ids=["code", "no code"])
def test_a_mistake_in_a_composed_plant_is_named(plant: str, message: str, code: bool) -> None:
    with pytest.raises(UsageError, match=message):
        suite(plant, names=None if code else static_names())


def test_a_range_that_ends_below_its_start_is_refused_by_the_experiment() -> None:
    with pytest.raises(UsageError, match=r"from 2 mm to 0\.1 cm ends below"):
        ready(plant=composed(errors=[kinematics("2 mm", "0.1 cm")]))


def test_plants_are_labelled_by_their_name_or_their_parts() -> None:
    text = """[
      "matched",
      { use = "composed", name = "L1", sensors = ["jitter"] },
      { use = "composed", effects = ["stribeck"], errors = ["base-tilt"] },
      { use = "composed", effects = ["stribeck"], errors = [{ use = "base-tilt", angle = 0.1 }] },
    ]"""
    cells = cells_of_suite(suite(text)).cells
    labels = {cell.labels["plant"]: cell for cell in cells}
    assert list(labels)[:2] == ["matched", "L1"]
    assert len(labels) == 4
    assert all(name.startswith("stribeck + base-tilt") for name in list(labels)[2:])
    # Errors of sensors may differ from repeat to repeat; exact signals of the others cannot.
    repeats = [sum(cell.labels["plant"] == name for cell in cells) for name in labels]
    assert repeats == [1, 2, 1, 1]


def test_the_name_of_a_plain_plant_is_its_own_and_it_is_its_only_effect() -> None:
    plain = {"use": "stribeck", "share": "20 %"}
    assert plant_name(plain) == "stribeck"
    assert [entry.spec for entry in composed_plant(plain)] == [plain]
    assert plant_name(composed()) == "matched"


@pytest.mark.parametrize("robot", ["scara", "panda", "ur5"])
def test_angles_are_lengths_on_slides_unless_a_length_is_written(robot: str) -> None:
    angle, length = {"from": 2e-4, "to": 2e-3}, {"from": "0.2 mm", "to": "2 mm"}
    slides = {joint.dofs[0] for joint in named_robot(robot).joints if joint.kind == "slide"}
    for written, scale in ((angle, SLIDE), (length, 1.0)):
        plant = composed(effects=[{"use": "lugre", "presliding": written}])
        prepared = ready(robot=robot, plant=plant, held_out=()).source.built
        (law,) = prepared.plant.laws
        Fc, _, sigma0, _, vs = law.numbers.reshape(5, -1)
        (row,) = prepared.values
        for name, distance, speed in zip(row["drawn"], Fc / sigma0, vs, strict=True):
            factor = scale if name in slides else 1.0
            assert row["drawn"][name] == pytest.approx(distance, rel=1e-12)
            assert 2e-4 * factor <= distance <= 2e-3 * factor
            # A number that holds for all joints, here a default, states no length.
            assert speed == pytest.approx(0.05 * (SLIDE if name in slides else 1.0))
