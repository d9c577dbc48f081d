"""Training data of several motions: the first is that of one, each has seeds of its own."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from sysid_bench.evaluation.interval_figures import FRICTION, INERTIAL
from sysid_bench.experiments.experiment_data import ExperimentData
from sysid_bench.experiments.simulated.source import SimulatedSource, pseudo_true
from sysid_bench.experiments.spec import ExperimentSpec
from sysid_bench.identification.estimators.linear import WLS
from sysid_bench.identification.identify import identify
from sysid_bench.signals.row_processing import RowProcessing
from sysid_bench.types import Array, Row
from tests.experiments.experiment_world import executed, ready, spec

NOISE = {"tau_relative": 0.01}
PLANAR = "scara"


def made(**changes: Any) -> ExperimentData[SimulatedSource]:
    return ready(**{"robot": PLANAR, "noise": NOISE, "held_out": (), **changes})


def positions(prepared: ExperimentData[SimulatedSource]) -> list[Array]:
    """Commanded positions (N, nq) of each training motion."""
    source = prepared.source
    spec = source.spec
    trainings = source.noise_free.simulated_motions
    if "motions" in spec.redrawn:
        trainings = tuple(replace(one, spec=spec) for one in trainings)
    return [training.commanded.q for training in trainings]


def test_one_motion_is_no_part_of_an_id() -> None:
    one = spec()
    assert "motions" not in one.to_json()
    assert "redrawn" not in one.to_json()
    several = replace(one, motions=5, redrawn=("motions", "plant"))
    assert several.id != one.id
    assert ExperimentSpec.from_json(several.to_json()) == several


@pytest.mark.parametrize("robot", [PLANAR, "random:mimic-gripper:1"])
def test_the_first_of_several_motions_is_that_of_one(robot: str) -> None:
    one, several = made(robot=robot), made(robot=robot, motions=3)
    assert one.problem.motions == ()
    first, *others = several.problem.motions
    assert len(others) == 2
    for ours, theirs in zip(first.factors, one.problem.factors, strict=True):
        np.testing.assert_array_equal(ours.R, theirs.R)
    assert several.problem.samples == 3 * one.problem.samples
    q = positions(several)
    assert not np.array_equal(q[1], q[0])
    assert not np.array_equal(q[1], q[2])


def test_each_motion_has_noise_of_its_own() -> None:
    exact, noisy = (made(motions=2, noise=noise).problem.motions for noise in ({}, NOISE))
    errors = [one.b - other.b for one, other in zip(noisy, exact, strict=True)]
    assert abs(np.corrcoef(*errors)[0, 1]) < 0.3


def test_several_motions_bound_the_variance_more_than_one() -> None:
    one, several = (made(motions=count).source.bound for count in (1, 4))
    assert one is not None
    assert several is not None
    assert (several < one).all()


def test_repeats_share_motions_unless_these_are_redrawn() -> None:
    kept = [positions(made(motions=2, repeat=i)) for i in (0, 1)]
    drawn = [positions(made(motions=2, repeat=i, redrawn=("motions",))) for i in (0, 1)]
    for index in (0, 1):
        np.testing.assert_array_equal(kept[0][index], kept[1][index])
        assert not np.array_equal(drawn[0][index], drawn[1][index])


def test_methods_that_simulate_one_motion_refuse_several() -> None:
    rows = executed(spec(robot=PLANAR, motions=2, noise=NOISE, held_out=()), "iv", "didim", "wls")
    assert [row["status"] for row in rows] == ["unsupported", "unsupported", "ok"]
    assert "simulates one recorded motion" in rows[0]["reason"]
    assert "2 motions" in rows[1]["reason"]


@pytest.mark.parametrize(
    ("changes", "match"),
    [
        ({"signals": {"filter": "none", "derivatives": "exact", "runs": "BB"}}, "leave out runs"),
        ({"task": "wrench", "sensor": "tool0"}, "force/torque sensors"),
    ],
)
def test_what_allows_one_motion_alone_is_refused(changes: dict[str, Any], match: str) -> None:
    (row,) = executed(spec(**{"motions": 2, "held_out": (), **changes}), "wls")
    assert row["status"] == "unsupported"
    assert match in row["reason"]


def test_a_row_has_every_interval_by_class_of_parameters() -> None:
    (row,) = executed(spec(robot=PLANAR, motions=5, noise=NOISE), "wls")
    kinds = {"motions", "residuals", "textbook"}
    for one in (INERTIAL, FRICTION):
        for name in ("coverage", "width", "interval_score"):
            assert set(row[f"{name}_{one}"]) == kinds, (one, name)
        # The score adds a penalty to the width.
        score, width = row[f"interval_score_{one}"], row[f"width_{one}"]
        assert all(score[kind] >= width[kind] * (1 - 1e-9) for kind in kinds)
    assert row["friction_target"] == "true"
    assert 0.0 <= row["torque_inside"] <= 1.0
    assert all("inside" in joint for joint in row["joints"])
    assert _mean_held(row, "motions") == pytest.approx(row["coverage"]["motions"])


def _mean_held(row: Row, kind: str) -> float:
    held = [entry[f"held_{kind}"] for entry in row["parameters_table"] if "class" in entry]
    return float(np.mean(held))


def test_few_motions_say_why_they_give_no_interval() -> None:
    (row,) = executed(spec(robot=PLANAR, motions=2, noise=NOISE), "wls")
    assert "motions" not in row["coverage"]
    assert row["no_motions_interval"] == "2 training motions; 5 are needed"


def test_friction_outside_of_the_model_is_judged_by_its_pseudo_true_value() -> None:
    stribeck = {"use": "stribeck", "share": "50 %"}
    plain, other = made(motions=5), made(motions=5, plant=stribeck, noise={})
    assert pseudo_true(plain.source.noise_free, RowProcessing()) is None
    limit = pseudo_true(other.source.noise_free, RowProcessing())
    assert limit is not None
    found = identify(WLS(), other.problem).beta
    assert found is not None
    true = other.problem.base.K @ other.source.truth.theta
    # Five motions of exact data are closer to the limit of many than to the model's own friction.
    assert np.abs(found - limit).max() < 0.5 * np.abs(true - limit).max()
