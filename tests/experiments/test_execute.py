"""`execute`: a row for each estimator, whatever happens; the same row for the same argument."""

import json
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sysid_bench.errors import LONGEST_TEXT
from sysid_bench.experiments import loaded_robot as robots
from sysid_bench.experiments import third_party
from sysid_bench.experiments.loaded_robot import KEPT, loaded_robot
from sysid_bench.experiments.simulated import noise_free
from sysid_bench.experiments.spec import ExperimentSpec
from sysid_bench.types import Row
from sysid_bench.words import MACHINE_FIELDS
from tests.closeness import assert_close
from tests.experiments.experiment_world import (
    CLOSED_LOOP,
    LOADS,
    RICH,
    SMOOTH,
    argument,
    executed,
    ready,
    rows_of,
    spec,
)

PLUGINS = "tests.experiments.plugins"
ONE_JOINT = Path(__file__).parents[1] / "identification" / "one_joint.py"


def checked(rows: list[Row], *statuses: str) -> list[Row]:
    """The rows, each a JSON object without NaN, in the order of the cells."""
    assert [row["status"] for row in rows] == list(statuses), [r.get("reason") for r in rows]
    assert [row["id"] for row in rows] == [f"cell{i}" for i in range(len(rows))]
    for row in rows:
        assert json.loads(json.dumps(row, allow_nan=False)) == row
        assert isinstance(row["reason"], str)
        assert bool(row["reason"]) == (row["status"] != "ok")
        assert row["robot"]
        assert row["estimator"]
    return rows


def test_every_estimator_gets_a_row_with_its_scores() -> None:
    start = time.perf_counter()
    ols, wls = checked(executed(spec(), "ols", {"use": "wls", "iterations": 3}), "ok", "ok")
    elapsed = time.perf_counter() - start
    # Times of the parts: preparation once, each estimator for itself.
    assert ols["seconds"] + wls["seconds"] + ols["seconds_experiment"] <= elapsed
    assert ols["seconds_experiment"] == wls["seconds_experiment"]
    for row in (ols, wls):
        assert row["crosscheck"] == "ok"
        assert row["torque_error"] < 1e-9
        assert row["rank"] == row["data_rank"] == len(row["parameters_table"]) == 48
        assert row["joints"][0]["name"] == "shoulder_pan_joint"
        assert row["seconds"] > 0
        assert row["seconds_experiment"] > 0
    assert "sigma_ratio" in wls["stats"]


def test_the_table_of_parameters_is_the_estimate_beside_the_truth() -> None:
    made = spec(noise={"tau_relative": 0.01}, robot="panda", payload="box-2kg")
    (row,) = checked(executed(made, "ols"), "ok")
    prepared = ready(**{f: getattr(made, f) for f in ("noise", "robot", "payload")})
    true = prepared.problem.base.K @ prepared.source.truth.theta
    names = [f"{p['body']}.{p['name']}" for p in row["parameters_table"]]
    assert tuple(names) == prepared.problem.base.names
    assert_close([p["true"] for p in row["parameters_table"]], true, 1e-12)
    error = np.array([p["estimate"] - p["true"] for p in row["parameters_table"]])
    std = np.array([p["std"] for p in row["parameters_table"]])
    assert (std > 0).all()
    assert np.linalg.norm(error) == pytest.approx(row["beta_error"] * np.linalg.norm(true))
    kinds = {p["identifiable"] for p in row["parameters_table"]}
    assert kinds == {"identifiable", "combination"}


UNSUPPORTED: dict[str, tuple[ExperimentSpec, str]] = {
    "no payload": (spec(task="payload"), "payload"),
    "floating in closed loop": (spec(robot="solo12", simulation=CLOSED_LOOP), "fixed base"),
    "ball in closed loop": (spec(robot="file:ball.xml", simulation=CLOSED_LOOP), "fixed base"),
    "no sensor": (spec(robot="solo12", task="wrench"), "sensor"),
}
FAILED: dict[str, tuple[ExperimentSpec, str]] = {
    "unknown robot": (spec(robot="ur55"), "ur5"),
    "unknown payload": (spec(payload="sphere"), "sphere-1kg"),
    "unknown task": (spec(task="robots"), "robot"),
    "unknown excitation": (spec(excitation={"use": "furier"}), "fourier"),
    "unknown held-out motion": (spec(held_out=({"use": "pttp"},)), "ptp"),
    "unknown simulation": (spec(simulation={"use": "open-loop"}), "closed-loop"),
    "unknown plant": (spec(plant={"use": "striebeck"}), "stribeck"),
    "unknown filter": (spec(signals={"filter": "butterfly"}), "butter"),
    "cut-off too high": (spec(signals={"filter": "butter 4 26 Hz"}), "26"),
    "too short": (spec(signals={"filter": "average 199"}), "too few"),
    "rates": (spec(simulation=CLOSED_LOOP, rate=300.0), "divide"),
}


def test_a_cell_looks_for_no_code_of_others(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = argument(spec(), "ols")
    for name in ("is_of_package", "is_third_party"):
        monkeypatch.setattr(third_party, name, lambda kind, name: pytest.fail(f"{kind} {name}"))
    checked(rows_of(asked), "ok")


@pytest.mark.parametrize("what", UNSUPPORTED)
def test_what_cannot_be_served_is_unsupported(what: str) -> None:
    made, words = UNSUPPORTED[what]
    for row in checked(executed(made, "ols", "wls"), "unsupported", "unsupported"):
        assert words in row["reason"]
        assert row["crosscheck"] == "ok"


@pytest.mark.parametrize("what", FAILED)
def test_what_is_wrong_fails_with_its_reason(what: str) -> None:
    made, words = FAILED[what]
    for row in checked(executed(made, "ols", "wls"), "failed", "failed"):
        assert words in row["reason"]


BROKEN: dict[str, tuple[str | dict[str, Any], str, bool]] = {
    "unknown": ("olss", "Did you mean 'ols'", False),
    "setting": ({"use": "wls", "iteration": 3}, "iterations", False),
    "no module": ("nowhere.at_all:Thing", "nowhere", False),
    "no method": (f"{PLUGINS}:ANSWER", "neither solve", False),
    "raising": (f"{PLUGINS}:Raising", "ZeroDivisionError: a mistake in the method", True),
    "chatty": (f"{PLUGINS}:Chatty", "Type", True),
    "vandal": (f"{PLUGINS}:Vandal", "read-only", True),
}


@pytest.mark.parametrize("what", BROKEN)
def test_one_broken_estimator_costs_the_others_nothing(what: str) -> None:
    estimator, words, raises = BROKEN[what]
    alone = executed(spec(), "ols")[0]
    before, broken, after = checked(executed(spec(), "ols", estimator, "ols"), "ok", "failed", "ok")
    assert words in broken["reason"]
    assert ("traceback" in broken) == raises
    assert broken["rank"] == alone["rank"]
    assert broken["condition"] == alone["condition"]
    for row in (before, after):
        assert timeless(row) == {**timeless(alone), "id": row["id"]}


def test_the_traceback_leads_to_the_methods_own_line() -> None:
    _, row = executed(spec(), "ols", f"{PLUGINS}:Raising")
    assert "plugins.py" in row["traceback"]
    assert 'raise ZeroDivisionError("a mistake in the method")' in row["traceback"]


@pytest.mark.parametrize("where", ["stop", "reason", "error"])
def test_a_row_keeps_the_start_of_a_long_text(where: str) -> None:
    [row] = executed(spec(), {"use": f"{PLUGINS}:Wordy", "where": where})
    assert row["status"] == ("ok" if where == "stop" else "failed")
    assert "xxx" in row["stop" if where == "stop" else "reason"]
    assert "x" * (LONGEST_TEXT + 1) not in json.dumps(row)


def test_numbers_that_are_not_finite_become_null() -> None:
    (row,) = checked(executed(spec(), f"{PLUGINS}:Infinite"), "ok")
    assert row["stats"] == {"last_step": None, "condition": None}


def test_a_motion_that_excites_too_little_fails_with_its_ranks() -> None:
    made = spec(excitation={"use": f"file:{ONE_JOINT}:OneJoint"})
    for row in checked(executed(made, "ols", "wls"), "failed", "failed"):
        assert f"excites {row['data_rank']} of {row['rank']}" in row["reason"]
        assert row["data_rank"] < row["rank"]
        assert row.get("condition") is None


def test_a_robot_that_fails_its_cross_check_is_skipped() -> None:
    for row in checked(executed(spec(), "ols", "wls", tolerance=0.0), "skipped", "skipped"):
        assert row["crosscheck"] == "failed"
        assert "gap" in row["reason"]
        assert row["gap"] > 0


def test_or_measured_all_the_same_where_the_suite_says_so() -> None:
    rows = rows_of(argument(spec(), "ols", tolerance=0.0, on_fail="continue"))
    (row,) = checked(rows, "ok")
    assert row["crosscheck"] == "failed"


def test_a_gap_that_is_not_a_number_is_null_in_the_row(monkeypatch: pytest.MonkeyPatch) -> None:
    honest = vars(robots)["crosscheck"]
    monkeypatch.setattr(
        robots, "crosscheck", lambda r: replace(honest(r), gap=float("nan"), native_gap=np.inf)
    )
    robots._load.cache_clear()
    try:
        (row,) = checked(executed(spec(), "ols"), "skipped")
    finally:
        robots._load.cache_clear()
    assert row["gap"] is None
    assert row["crosscheck"] == "failed"


# --- The same thing twice, and draws that are shared --------------------------------------------


def timeless(row: Row) -> Row:
    return {key: value for key, value in row.items() if key not in MACHINE_FIELDS}


SAME: dict[str, ExperimentSpec] = {
    "inverse": spec(robot="panda", payload="rod-1kg", noise={"q": 1e-4, "tau_relative": 0.01}),
    "closed loop": spec(robot=SMOOTH, simulation=CLOSED_LOOP, noise={"q": 1e-4, "quantum": 1e-4}),
    "floating": spec(robot="solo12", noise={"tau": 0.1}),
}


@pytest.mark.parametrize("what", SAME)
def test_the_same_argument_gives_the_same_row(what: str) -> None:
    first = executed(SAME[what], "ols", "wls")
    robots._load.cache_clear()  # a worker without this robot
    executed(spec(robot="ur10"), "ols")
    second = executed(SAME[what], "ols", "wls")
    for one, two in zip(first, second, strict=True):
        assert timeless(one) == timeless(two)


def test_rows_depend_on_no_other_estimator() -> None:
    made = SAME["inverse"]
    alone, among = executed(made, "wls")[0], executed(made, "ols", "wls")[1]
    assert timeless(alone) == {**timeless(among), "id": "cell0"}


def noise_of(**changes: Any) -> np.ndarray:
    exact = ready(**{**changes, "noise": {}}).experiment.raw
    return np.asarray(ready(**changes).experiment.raw.tau - exact.tau)


def test_two_noise_levels_share_their_draws() -> None:
    one, two = (noise_of(noise={"tau_relative": s}) for s in (0.01, 0.03))
    np.testing.assert_allclose(two, 3 * one, rtol=1e-6, atol=1e-10)


def test_two_payloads_share_their_draws() -> None:
    """Absolute noise is the same number for number, whatever is mounted."""
    one, two = (noise_of(noise={"tau": 0.2}, payload=p) for p in ("none", "box-2kg"))
    np.testing.assert_allclose(one, two, atol=1e-10)


def test_repeats_and_seeds_do_not() -> None:
    base = noise_of(noise={"tau": 0.2})
    for other in (
        noise_of(noise={"tau": 0.2}, repeat=1),
        noise_of(noise={"tau": 0.2}, seed=2),
        noise_of(noise={"tau": 0.2}, robot="ur10"),
    ):
        assert abs(np.corrcoef(base.ravel(), other.ravel())[0, 1]) < 0.2


@pytest.mark.parametrize("simulation", [{"use": "inverse"}, CLOSED_LOOP], ids=str)
def test_all_payloads_and_repeats_share_the_motion(simulation: dict[str, str]) -> None:
    def motions(**changes: Any) -> list[np.ndarray]:
        made = ready(robot="ur5", simulation=simulation, **changes)
        commanded = made.experiment.raw.commanded
        # In inverse simulation the motion is the commanded one, and noise is all that hides it:
        # there methods do not get it.
        assert (commanded is None) == (simulation["use"] == "inverse")
        exact = made.experiment.recording.motion.a if commanded is None else commanded.q
        held = [np.concatenate([b for b, _ in p.blocks()]) for p in made.held_out.values()]
        return [exact, *(h for h in held if "payload" not in changes)]

    base = motions()
    for load in LOADS:
        np.testing.assert_array_equal(motions(payload=load)[0], base[0])
    for again in (motions(repeat=1), motions(noise={"tau": 0.1})):
        for one, two in zip(base, again, strict=True):
            np.testing.assert_array_equal(one, two)
    assert np.abs(motions(seed=2)[0] - base[0]).max() > 0.1


def test_held_out_motions_are_never_the_training_motion() -> None:
    same = {"use": "fourier", "period": "4 s", "cycles": 1}
    made = ready(excitation=same, held_out=(same, same))
    trained, first, second = made.problem.b, *(p.b for p in made.held_out.values())
    assert list(made.held_out) == ["fourier", "fourier-1"]
    assert np.abs(trained - first).max() > 0.1
    assert np.abs(first - second).max() > 0.1


def test_held_out_torques_are_exact() -> None:
    exact, noisy = ready(), ready(noise={"q": 1e-3, "tau": 1.0})
    for name, problem in exact.held_out.items():
        np.testing.assert_array_equal(problem.b, noisy.held_out[name].b)


def test_a_worker_keeps_its_robots() -> None:
    one, two = (loaded_robot("ur5", "box-2kg", None, None) for _ in range(2))
    assert one is two
    assert one.base_map(("x",)[:0] + one.robot.inertial_columns) is one.base_map(
        one.robot.inertial_columns
    )
    assert loaded_robot("ur5", {"mass": 2.0}, None, None) is not one
    assert loaded_robot("ur5", {"mass": 2}, None, None).robot.payload.mass == 2.0
    assert robots._load.cache_info().maxsize == KEPT


PERIODIC = {"use": "fourier", "harmonics": 2, "period": "2 s", "cycles": 6}


def test_deviations_say_where_they_come_from() -> None:
    noise = {"tau_relative": 0.01}
    periodic, short = (
        executed(spec(noise=noise, excitation=excitation, robot=RICH), "ols", "wls", "huber")
        for excitation in (PERIODIC, {**PERIODIC, "cycles": 4})
    )
    for rows, first in ((periodic, "periods"), (short, "residuals")):
        for row, kinds in zip(rows, (first, first, "textbook"), strict=True):
            for parameter in row["parameters_table"]:
                assert parameter["std_from"] == kinds
                assert parameter["std"] == parameter[f"std_{kinds}"] > 0
                assert ("std_residuals" in parameter) == (kinds != "textbook")
                assert parameter["bound"] > 0
                assert (
                    abs(parameter["base_error"] - parameter["estimate"] + parameter["true"]) < 1e-9
                )
            assert first == "residuals" or set(row["coverage"]) >= {kinds, "textbook"}
            assert all(0 <= share <= 1 for share in row["coverage"].values())


def test_deviations_and_bound_grow_with_the_noise() -> None:
    """The same draw at twice the level: errors, deviations and the bound are twice as large."""
    one, two = (
        executed(
            spec(noise={"tau": tau, "tau_correlation": 0.9}, excitation=PERIODIC, robot=RICH), "ols"
        )[0]["parameters_table"]
        for tau in (0.1, 0.2)
    )
    for single, double in zip(one, two, strict=True):
        for key in ("bound", "base_error", "std_periods", "std_residuals", "std_textbook"):
            assert double[key] == pytest.approx(2 * single[key], rel=1e-6), key


@pytest.mark.parametrize(
    ("changes", "bounded"),
    [
        ({"noise": {"tau": 0.1}}, True),
        ({"noise": {"tau": 0.1, "q": 1e-4}}, True),
        ({"noise": {"q": 1e-4}}, False),
        ({"noise": {}}, False),
    ],
)
def test_the_bound_is_one_of_torque_noise(changes: dict[str, Any], bounded: bool) -> None:
    (row,) = executed(spec(robot=RICH, **changes), "ols")
    assert all(("bound" in parameter) == bounded for parameter in row["parameters_table"])
    assert bool(row["coverage"]) == bool(changes["noise"])


def test_an_experiment_is_the_same_alone_and_after_others() -> None:
    """The noise-free part is shared: no repeat may depend on another one."""
    made = spec(noise={"tau": 0.1, "q": 1e-5}, robot=RICH, repeat=2)
    noise_free._shared_part.cache_clear()
    (alone,) = executed(made, "wls")
    for other in (replace(made, repeat=1), replace(made, noise={"tau": 0.3})):
        executed(other, "wls", f"{PLUGINS}:Vandal")
    (after,) = executed(made, "wls")
    same = [key for key in alone if key not in MACHINE_FIELDS]
    assert {key: after[key] for key in same} == {key: alone[key] for key in same}
