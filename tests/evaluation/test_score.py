"""Every figure of a score against its definition, by brute force from dense rows."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from sysid_bench.evaluation.score import data_figures, score
from sysid_bench.evaluation.torque_errors import SMALL_JOINT
from sysid_bench.experiments.experiment_data import ExperimentData
from sysid_bench.experiments.simulated.source import SimulatedSource
from sysid_bench.identification.estimators.linear import OLS, WLS
from sysid_bench.identification.identify import identify
from sysid_bench.models.load import load_robot
from sysid_bench.spatial import (
    body_mass_inertia,
    pseudo_inertia,
    pseudo_inertia_distance,
)
from sysid_bench.types import Array, Estimate, Problem, Score
from tests.closeness import assert_close
from tests.experiments.experiment_world import LOADS, RICH, SHIPPED, dense, ready, ready_once

PLACES = [
    ("ur5", "none", "robot"),
    ("panda", "box-2kg", "robot"),
    ("solo12", "none", "robot"),
    ("z1", "rod-1kg", "payload"),
    ("ur10", "sphere-offset-1kg", "link"),
    (RICH, "none", "robot"),
]
HELD_OUT = ({"use": "ptp", "moves": 2}, {"use": "fourier-other"}, {"use": "ptp", "moves": 1})


@cache
def noisy(robot: str, payload: str, task: str) -> ExperimentData[SimulatedSource]:
    noise = {"tau_relative": 0.02}
    return ready(robot=robot, payload=payload, task=task, noise=noise, held_out=HELD_OUT)


def scored(
    made: ExperimentData[SimulatedSource], estimate: Estimate | None = None
) -> tuple[Score, Array]:
    """The score of an estimate (default: weighted least squares), and its beta."""
    estimate = estimate or identify(WLS(), made.problem)
    assert estimate.beta is not None
    return score(estimate, made.problem, made.held_out, made.source.truth), estimate.beta


def rms(x: Array, axis: int | None = None) -> Array:
    return np.asarray(np.sqrt((x**2).mean(axis=axis)))


def rows_of(problems: list[Problem]) -> tuple[Array, Array]:
    """W (M, rows, r), b (M, rows) of several motions."""
    parts = [dense(problem) for problem in problems]
    return np.concatenate([Y for Y, _ in parts]), np.concatenate([b for _, b in parts])


def largest_of_its_kind(size: np.ndarray, kinds: tuple[str, ...]) -> np.ndarray:
    """For each row the largest RMS among rows of the same kind: forces are not torques."""
    return np.array(
        [max(s for s, other in zip(size, kinds, strict=True) if other == kind) for kind in kinds]
    )


def torques_of(problems: list[Problem]) -> np.ndarray:
    """RMS of the whole torque of each row over several motions."""
    squares = [p.samples * p.torque**2 for p in problems if p.torque is not None]
    return np.sqrt(sum(squares) / sum(p.samples for p in problems))


def judged(size: np.ndarray, problem: Problem) -> np.ndarray:
    """The rows that carry torque and that an unknown acts on."""
    acts = np.abs(dense(problem)[0]).max(axis=(0, 2), initial=0.0) > 0
    return np.asarray(acts & (size >= SMALL_JOINT * largest_of_its_kind(size, problem.kinds)))


@pytest.mark.parametrize("place", PLACES, ids=str)
def test_the_torque_that_errors_are_compared_with_is_the_measured_one(
    place: tuple[str, str, str],
) -> None:
    made = noisy(*place)
    rows = [made.robot.torque_rows.index(row) for row in made.problem.rows]
    assert made.problem.torque is not None
    np.testing.assert_array_equal(
        made.problem.torque, rms(made.experiment.recording.tau[:, rows], axis=0)
    )
    b = np.concatenate([values for _, values in made.problem.blocks()])
    if not made.source.known.any():
        assert_close(rms(b, axis=0), made.problem.torque, 1e-12)


@pytest.mark.parametrize("place", PLACES, ids=str)
def test_errors_are_what_they_say(place: tuple[str, str, str]) -> None:
    made = noisy(*place)
    figures, beta = scored(made)
    Y, b = dense(made.problem)
    assert figures.rmse_train == pytest.approx(rms(Y @ beta - b), rel=1e-8)
    Yh, bh = rows_of(list(made.held_out.values()))
    error = Yh @ beta - bh
    assert figures.rmse_test == pytest.approx(rms(error), rel=1e-7)
    size = torques_of(list(made.held_out.values()))
    large = judged(size, made.problem)
    relative = rms(error, axis=0)[large] / size[large]
    assert figures.torque_error == pytest.approx(rms(relative), rel=1e-7)
    assert figures.torque_error_worst == pytest.approx(relative.max(), rel=1e-7)
    if set(made.problem.kinds) == {"joint N m"}:
        lengths = np.linalg.norm(error, axis=1) / np.linalg.norm(bh, axis=1)
        assert figures.torque_error_sample == pytest.approx(lengths.mean(), rel=1e-7)
    else:  # newtons and newton metres have no common length
        assert figures.torque_error_sample is None
    star = made.problem.base.K @ made.source.truth.theta
    expected = np.linalg.norm(Yh @ (beta - star)) / np.linalg.norm(Yh @ star)
    assert figures.parameter_error == pytest.approx(expected, rel=1e-7)
    expected = np.linalg.norm(beta - star) / np.linalg.norm(star)
    assert figures.beta_error == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("place", PLACES, ids=str)
def test_every_motion_and_every_joint_is_distinguished(place: tuple[str, str, str]) -> None:
    made = noisy(*place)
    figures, beta = scored(made)
    assert list(figures.torque_error_by_motion) == ["ptp", "fourier-other", "ptp-2"]
    for name, reported in figures.torque_error_by_motion.items():
        Y, b = dense(made.held_out[name])
        size = torques_of([made.held_out[name]])
        large = judged(size, made.problem)
        expected = rms((rms(Y @ beta - b, axis=0) / np.where(size > 0, size, 1.0))[large])
        assert reported == pytest.approx(expected, rel=1e-7)
    Y, b = dense(made.problem)
    Yh, bh = rows_of(list(made.held_out.values()))
    size = torques_of(list(made.held_out.values()))
    assert [joint["name"] for joint in figures.joints] == list(made.problem.rows)
    for i, joint in enumerate(figures.joints):
        assert joint["rmse_train"] == pytest.approx(rms(Y[:, i] @ beta - b[:, i]), rel=1e-7)
        assert joint["rmse_test"] == pytest.approx(rms(Yh[:, i] @ beta - bh[:, i]), rel=1e-7)
        assert joint["rms"] == pytest.approx(size[i], rel=1e-9)
        if np.abs(Y[:, i]).any():
            assert joint["relative"] == pytest.approx(joint["rmse_test"] / joint["rms"], rel=1e-9)
        else:
            assert joint["relative"] is None
        assert joint["small"] == (size[i] < 0.01 * largest_of_its_kind(size, made.problem.kinds)[i])


@pytest.mark.parametrize("place", PLACES, ids=str)
def test_conditioning_is_that_of_the_dense_regressor(place: tuple[str, str, str]) -> None:
    made = noisy(*place)
    figures, _ = scored(made)
    W = made.problem.W
    assert figures.rank == figures.data_rank == W.shape[1]
    assert figures.parameters == len(made.problem.parameters)
    assert figures.condition == pytest.approx(np.linalg.cond(W), rel=1e-6)
    unit = W / np.linalg.norm(W, axis=0)
    assert figures.condition_unit == pytest.approx(np.linalg.cond(unit), rel=1e-6)


@pytest.mark.parametrize("place", [p for p in PLACES if p[2] != "link"], ids=str)
def test_d_optimality_is_the_information_about_the_held_out_torques(
    place: tuple[str, str, str],
) -> None:
    """Minus the log of the product of the non-zero eigenvalues of H (W'W)^-1 H' per sample."""
    made = noisy(*place)
    figures, _ = scored(made)
    Y, _ = dense(made.problem)
    Yh, _ = rows_of(list(made.held_out.values()))
    size = torques_of(list(made.held_out.values()))
    scaled, scaled_h = (
        np.where(size > 0, A.transpose(0, 2, 1) / np.where(size > 0, size, 1.0), 0.0)
        .transpose(0, 2, 1)
        .reshape(-1, A.shape[2])
        for A in (Y, Yh)
    )
    # Eigenvalues of (W'W)^-1 (H'H / samples), by singular values of H R^-1: better conditioned.
    R = np.asarray(np.linalg.qr(scaled, mode="r"))
    values = np.linalg.svd(np.linalg.solve(R.T, scaled_h.T) / np.sqrt(len(Yh)), compute_uv=False)
    values = values[values > 1e-9 * values[0]]
    assert figures.d_optimality == pytest.approx(-2 * np.log(values).sum(), rel=1e-6, abs=1e-5)


def test_twice_the_data_is_log_two_per_direction_of_information() -> None:
    one = ready(excitation={"use": "fourier", "period": "4 s", "cycles": 1})
    two = ready(excitation={"use": "fourier", "period": "4 s", "cycles": 1}, rate=100.0)
    figures = [scored(made)[0] for made in (one, two)]
    gain = (figures[1].d_optimality or 0) - (figures[0].d_optimality or 0)
    assert gain == pytest.approx(figures[0].rank * np.log(2), rel=0.1)


@pytest.mark.parametrize("place", PLACES, ids=str)
def test_the_true_parameters_make_every_error_zero(place: tuple[str, str, str]) -> None:
    made = noisy(*place)
    figures, _ = scored(made, Estimate(made.problem.base.K @ made.source.truth.theta))
    assert figures.beta_error == figures.parameter_error == 0.0
    for reported in (figures.torque_error, *figures.torque_error_by_motion.values()):
        assert reported is not None
        assert reported < 1e-12
    assert figures.rmse_train is not None
    assert figures.rmse_train > 1e-4  # the training torque is as measured, with its noise


@pytest.mark.parametrize("task", ["payload", "link"])
@pytest.mark.parametrize("load", ["point-1kg", "sphere-offset-1kg", "box-2kg"])
def test_payload_figures_are_mass_com_and_possibility(task: str, load: str) -> None:
    made = noisy("panda", load, task)
    figures, beta = scored(made)
    theta = made.problem.base.embed(beta)
    (body,) = made.problem.bodies
    assert body.columns == made.source.truth.parameters
    star = made.source.truth.theta
    mass, com, inertia = body_mass_inertia(theta)
    mass_star, com_star, inertia_star = body_mass_inertia(star)
    if made.problem.base.rank < 10:
        assert figures.payload_error is None
        return
    error = np.linalg.norm(theta - star) / np.linalg.norm(star)
    assert figures.payload_error == pytest.approx(error, rel=1e-9)
    assert figures.mass_error == pytest.approx(abs(mass - mass_star), rel=1e-9)
    assert figures.com_error == pytest.approx(float(np.linalg.norm(com - com_star)), rel=1e-9)
    assert figures.payload_mass_error == figures.mass_error
    relative = abs(mass / mass_star - 1)
    assert figures.payload_mass_error_relative == pytest.approx(relative, rel=1e-6)
    assert figures.payload_com_error == figures.com_error
    if load != "point-1kg":  # of a point, whose inertia is zero, there is no share
        moved = np.linalg.norm(inertia - inertia_star) / np.linalg.norm(inertia_star)
        assert figures.payload_inertia_error == pytest.approx(moved, rel=1e-6)
    expected = pseudo_inertia_distance(theta, star)
    assert (figures.payload_distance is None) == (expected is None)
    assert figures.payload_distance == (None if expected is None else pytest.approx(expected))
    smallest = np.linalg.eigvalsh(pseudo_inertia(theta))[0]
    assert figures.min_eigenvalue == pytest.approx(smallest, rel=1e-6, abs=1e-12)
    assert figures.feasible == bool(smallest >= -1e-9 * np.abs(theta).max())


def test_bodies_are_judged_only_where_all_their_numbers_are_claimed() -> None:
    made = noisy("ur5", "none", "robot")
    figures, beta = scored(made)
    assert figures.feasible is None
    assert figures.min_eigenvalue is None
    claimed, _ = scored(made, Estimate(beta, theta=made.source.truth.theta))
    assert claimed.feasible is True
    impossible = made.source.truth.theta.copy()
    impossible[made.problem.parameters.index(made.problem.bodies[2].columns[0])] = -1.0
    refused, _ = scored(made, Estimate(beta, theta=impossible))
    assert refused.feasible is False
    assert refused.min_eigenvalue is not None
    assert refused.min_eigenvalue < 0


@pytest.mark.parametrize("status", ["failed", "unsupported"])
def test_what_failed_still_carries_rank_and_condition(status: str) -> None:
    made = noisy("ur5", "none", "robot")
    failed = Estimate(status=status, reason="why not")  # type: ignore[arg-type]
    figures = score(failed, made.problem, made.held_out, made.source.truth)
    full, _ = scored(made)
    for name in data_figures(made.problem, made.held_out):
        assert getattr(figures, name) == getattr(full, name) is not None
    assert figures.torque_error is None
    assert figures.joints == ()


def test_without_held_out_motions_there_is_no_held_out_figure() -> None:
    made = ready(held_out=())
    figures, _ = scored(made)
    assert figures.rmse_train is not None
    for name in ("rmse_test", "torque_error", "parameter_error", "d_optimality"):
        assert getattr(figures, name) is None
    assert figures.torque_error_by_motion == {}


def test_a_motion_that_excites_too_little_has_a_rank_and_no_condition() -> None:
    made = noisy("ur5", "none", "robot")
    few = replace(
        made.problem,
        factors=tuple(replace(f, R=np.zeros_like(f.R)) for f in made.problem.factors),
    )
    figures = data_figures(few, made.held_out)
    assert figures["data_rank"] == 0
    assert figures["rank"] == made.problem.base.rank
    assert "condition" not in figures


def test_a_joint_without_held_out_torque_is_small_and_breaks_nothing() -> None:
    """As a point on the axis of a vertical joint: nothing to compare with, yet a full problem."""
    made = ready_once("ur5", "point-1kg", "payload")
    zero = {
        name: replace(
            test,
            torque=np.zeros(len(test.rows)),
            factors=tuple(
                replace(f, R=np.column_stack([f.R[:, :-1], np.zeros(len(f.R))]))
                for f in test.factors
            ),
        )
        for name, test in made.held_out.items()
    }
    figures = score(Estimate(np.zeros(10)), made.problem, zero, made.source.truth)
    assert figures.torque_error is None
    assert figures.d_optimality is None
    assert figures.condition is not None
    assert all(joint["small"] and joint["relative"] is None for joint in figures.joints)


@pytest.mark.parametrize("name", SHIPPED)
def test_exact_payloads_are_exact(name: str) -> None:
    for load in LOADS:
        for task in ("payload", "link"):
            made = ready_once(name, load, task)
            figures, _ = scored(made, identify(OLS(), made.problem))
            if made.problem.base.rank == 10:
                assert figures.payload_error is not None
                assert figures.payload_error <= 1e-8
            assert figures.beta_error is not None
            assert figures.beta_error <= 1e-8
            assert figures.torque_error is not None
            assert figures.torque_error <= 1e-9
            reported = [
                joint["relative"] for joint in figures.joints if joint["relative"] is not None
            ]
            assert max(reported) <= 1e-9
    assert load_robot(name).payload_body is None
