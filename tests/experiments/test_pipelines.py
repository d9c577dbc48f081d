"""Pipelines: linear in the rows, consistent for methods, and honest about standstill."""

import itertools
from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sysid_bench.errors import UsageError
from sysid_bench.evaluation.torque_errors import RowErrors
from sysid_bench.experiments.experiment_data import ExperimentData
from sysid_bench.experiments.processed_rows import MotionRows
from sysid_bench.identification.estimators.didim_iv import DIDIM
from sysid_bench.identification.estimators.linear import WLS
from sysid_bench.identification.estimators.robust import Huber
from sysid_bench.identification.linear.least_squares import dense_rows, stacked_factor
from sysid_bench.plugin_names import build
from sysid_bench.signals.filter import Butterworth, NoFilter
from sysid_bench.signals.pipeline_choice import pipeline_of
from sysid_bench.signals.row_processing import RowProcessing
from sysid_bench.signals.spectrum import bandwidth
from sysid_bench.types import Array, Problem
from tests.experiments.experiment_world import (
    CLOSED_LOOP,
    RICH,
    motion_of,
    ready,
    robot_of,
)

RATE = 100.0
NOISE = {"q": 1e-5, "tau_relative": 0.01}
FROM_Q = {"filter": "butter 4 20 Hz zero-phase", "derivatives": "from q", "torque": "filtered"}
PIPELINES: tuple[Mapping[str, Any], ...] = (
    {"use": "parallel"},
    {"use": "parallel", "cutoff": "6 Hz", "standstill": "20 %"},
    {"use": "parallel", "cutoff": "8 Hz", "weight": 0.3},
    {"use": "plain", "standstill": "10 %"},
    {"use": "raw", "standstill": 0.2, "weight": "50 %"},
)
ROBOTS = ("ur5", "file:free.xml", "random:four-bar:7")


def loop(
    pipeline: Mapping[str, Any] | None, robot: str = "ur5", **changes: Any
) -> ExperimentData[Any]:
    """A closed loop with Coulomb friction and low noise."""
    fields = {"simulation": CLOSED_LOOP, "rate": RATE, "noise": NOISE, "signals": FROM_Q, **changes}
    return ready(robot=robot, pipeline=pipeline, **fields)


def digest(problem: Problem) -> list[Array]:
    parts = [x for block in problem.blocks() for x in block]
    return [*(factor.R for factor in problem.factors), *parts]


# --- Rows ---------------------------------------------------------------------------------------


@given(
    seed=st.integers(0, 99),
    filter=st.sampled_from([NoFilter(), Butterworth(4, 6.0), Butterworth(2, 12.0)]),
    step=st.integers(1, 9),
    standstill=st.floats(0.0, 0.5),
    weight=st.floats(0.0, 1.0),
)
@settings(max_examples=20, deadline=None)
def test_processed_rows_have_the_same_solution(
    seed: int, filter: Any, step: int, standstill: float, weight: float
) -> None:
    rng = np.random.default_rng(seed)
    W, beta, v = rng.normal(size=(200, 3, 5)), rng.normal(size=5), rng.normal(size=(200, 3))
    processing = RowProcessing(filter, step, standstill, weight)
    rows = MotionRows(processing, processing.weights(v), RATE)
    np.testing.assert_allclose(rows.processed(W) @ beta, rows.processed(W @ beta), atol=1e-12)
    slow = np.abs(v) < standstill * np.sqrt((v**2).mean(axis=0))
    np.testing.assert_array_equal(rows.weights, np.where(slow, weight, 1.0))


def test_without_settings_rows_are_untouched() -> None:
    x = np.random.default_rng(0).normal(size=(50, 4))
    plain = RowProcessing()
    assert plain.is_plain
    assert plain.apply(x, plain.weights(x[:, :1])[:, 0], RATE) is not None
    np.testing.assert_array_equal(plain.apply(x, np.ones(50), RATE), x)


@pytest.mark.parametrize("wrong", [{"standstill": 1.0}, {"standstill": -0.1}, {"weight": 1.5}])
@pytest.mark.parametrize("name", ["plain", "raw", "parallel"])
def test_impossible_shares_are_refused(name: str, wrong: dict[str, float]) -> None:
    with pytest.raises(UsageError, match="share of the RMS rate"):
        build("pipeline", {"use": name, **wrong})


@pytest.mark.parametrize("wrong", [{"cutoff": "0 Hz"}, {"order": 0}, {"derivatives": "exact"}])
def test_impossible_filters_are_refused(wrong: dict[str, Any]) -> None:
    with pytest.raises(UsageError, match=r"positive|from q"):
        build("pipeline", {"use": "parallel", **wrong})


# --- Problems -----------------------------------------------------------------------------------


@pytest.mark.parametrize("robot", ROBOTS)
@pytest.mark.parametrize("pipeline", PIPELINES)
def test_a_problem_is_the_same_in_factors_and_in_blocks(
    robot: str, pipeline: Mapping[str, Any]
) -> None:
    made = loop(pipeline, robot, simulation={"use": "inverse"})
    problem = made.problem
    R, both = stacked_factor(problem), np.column_stack([problem.W, problem.b])
    np.testing.assert_allclose(R.T @ R, both.T @ both, rtol=0, atol=1e-9 * (both**2).sum())
    assert len(problem.b) == problem.samples * len(problem.rows)
    assert all(0 < factor.samples <= problem.samples for factor in problem.factors)
    recording = made.experiment.recording
    W = np.concatenate(list(made.experiment.regress(recording.motion)))
    np.testing.assert_allclose(
        made.experiment.filter_rows(W).reshape(problem.W.shape), problem.W, atol=1e-9
    )


@pytest.mark.parametrize("robot", ROBOTS)
def test_plain_is_the_processing_that_signals_describe(robot: str) -> None:
    named = loop({"use": "plain", "standstill": 0}, robot, simulation={"use": "inverse"})
    silent = loop(None, robot, simulation={"use": "inverse"})
    for a, b in zip(digest(named.problem), digest(silent.problem), strict=True):
        np.testing.assert_array_equal(a, b)


def test_raw_is_plain_without_a_filter() -> None:
    signals = {"filter": "none", "derivatives": "from q", "torque": "raw"}
    pairs = zip(
        digest(loop({"use": "raw"}).problem),
        digest(loop(None, signals=signals).problem),
        strict=True,
    )
    assert all(np.array_equal(a, b) for a, b in pairs)


# --- Contacts -----------------------------------------------------------------------------------

SENSOR: Mapping[str, Any] = {
    "robot": "icub", "task": "wrench", "sensor": "l_arm", "rate": 100.0,
    "excitation": {"use": "wander", "duration": "15 s"},
}  # fmt: skip
ENCODERS = {"q": 1e-5, "force": 0.05, "moment": 0.002}


@given(seed=st.integers(0, 99), start=st.integers(0, 150), length=st.integers(1, 40))
@settings(max_examples=20, deadline=None)
def test_a_filter_of_rows_spreads_nothing_of_a_contact(seed: int, start: int, length: int) -> None:
    rng = np.random.default_rng(seed)
    touched = np.zeros(200, dtype=bool)
    touched[start : start + length] = True
    processing = RowProcessing(Butterworth(4, 6.0), 3)
    rows = MotionRows(processing, np.where(touched, 0.0, 1.0)[:, None], RATE)
    quiet, loud = (rng.normal(size=(200, 1)) for _ in range(2))
    loud = np.where(touched[:, None], 1e3 * loud, quiet)
    np.testing.assert_array_equal(rows.processed(quiet), rows.processed(loud))
    assert rows.count(0) == round((200 - touched.sum()) / 3)


@pytest.mark.parametrize(
    "contacts", ["detect", pytest.param(["5 s to 10 s"], marks=pytest.mark.long)]
)
def test_contacts_are_left_out_before_the_filter_with_its_margin(contacts: Any) -> None:
    """A hand that is touched for a third of the time is identified as well as a free one."""
    errors = {}
    for name, noise, signals in (
        ("free", ENCODERS, {}),
        ("blind", {**ENCODERS, "touch": 5.0}, {}),
        ("aware", {**ENCODERS, "touch": 5.0}, {"contacts": contacts}),
    ):
        made = ready(**SENSOR, noise=noise, signals=signals, pipeline={"use": "parallel"})
        errors[name] = made.score(WLS(), WLS().solve(made.problem))["torque_error"]
    assert 1 / 3 < made.source.left_out < 0.45
    assert len(made.source.motion) == round(
        (1 - made.source.left_out) * len(made.experiment.recording)
    )
    assert made.fields["standstill"] == 0.0  # contacts are counted apart
    assert errors["blind"] > 5 * errors["aware"]
    assert errors["aware"] < 3 * errors["free"]


# --- Standstill ---------------------------------------------------------------------------------


def test_rows_at_standstill_are_left_out_and_counted() -> None:
    made = loop({"use": "plain", "standstill": "10 %"})
    motion, problem = made.experiment.recording.motion, made.problem
    limit = 0.1 * np.sqrt((motion.v**2).mean(axis=0))
    slow = np.abs(motion.v) < limit
    assert 0.02 < slow.mean() < 0.4
    assert made.fields["standstill"] == slow.mean()
    assert [factor.samples for factor in problem.factors] == list((~slow).sum(axis=0))
    W = np.concatenate([block for block, _ in problem.blocks()])
    np.testing.assert_array_equal(~np.any(W, axis=2), slow)


def test_robust_scales_are_those_of_the_rows_that_count() -> None:
    """Rows that are left out have no residual: they must not make the others outliers."""
    made = loop({"use": "plain", "standstill": "45 %"})
    robust, least = Huber().solve(made.problem), WLS().solve(made.problem)
    assert robust.beta is not None
    assert least.beta is not None
    betas = (robust.beta, least.beta)
    errors = [RowErrors(list(made.held_out.values()), beta).torque_error for beta in betas]
    assert errors[0] is not None
    assert errors[1] is not None
    assert errors[0] < 1.5 * errors[1]


@pytest.mark.long
def test_standstill_and_parallel_filtering_repair_least_squares_in_closed_loop() -> None:
    """A joint that sticks has friction between its limits, and sign(v) at one of them. The errors
    of single draws scatter by a factor of two: the mean over robots and draws is judged."""
    ratios = []
    for robot, repeat in itertools.product(("scara", "ur3", "ur5"), (0, 1)):
        errors = {}
        for name, pipeline in {"plain": None, "parallel": {"use": "parallel"}}.items():
            simulation = {"use": "closed-loop", "rate": "1 kHz"}
            made = loop(pipeline, robot, simulation=simulation, repeat=repeat)
            row = made.score(WLS(), WLS().solve(made.problem))
            errors[name] = row["torque_error_moving"]
        ratios.append(errors["parallel"] / errors["plain"])
    assert np.exp(np.log(ratios).mean()) < 0.5


@pytest.mark.parametrize(("robot", "rate"), [(RICH, 500.0), (RICH, 1000.0)])
def test_a_held_torque_belongs_to_the_middle_of_its_period(robot: str, rate: float) -> None:
    """The residual of the true parameters is a shift in time: half a control period with the
    torque at the samples, next to nothing with the default pipeline. The plant's own step, whose
    force acts at its start, takes a tenth of it."""
    shifts = {}
    for name, pipeline in (
        ("raw", {"use": "raw", "standstill": 0.1}),
        ("parallel", {"use": "parallel", "cutoff": "10 Hz"}),
    ):
        simulation = {"use": "closed-loop", "rate": rate, "substeps": 10}
        made = loop(pipeline, robot, simulation=simulation, noise={}, rate=rate / 2)
        experiment, problem = made.experiment, made.problem
        assert experiment.raw.controller is not None
        assert experiment.raw.controller.held
        theta = made.source.truth.theta
        left = (problem.b - problem.W @ (problem.base.K @ theta)).reshape(problem.samples, -1)
        tau = experiment.recording.tau
        slope = experiment.filter_rows(np.gradient(tau, 2 / rate, axis=0)).reshape(left.shape)
        shifts[name] = np.median((left * slope).sum(axis=0) / (slope**2).sum(axis=0))
    assert 0.6 * 0.5 / rate < shifts["raw"] < 1.1 * 0.5 / rate
    assert abs(shifts["parallel"]) < 0.2 * shifts["raw"]


@pytest.mark.parametrize(
    "pipeline",
    [
        {"use": "plain", "standstill": "10 %"},
        {"use": "parallel", "standstill": "5 %"},
        {"use": "parallel", "cutoff": "10 Hz"},
    ],
    ids=str,
)
def test_didim_on_the_rows_of_the_pipeline_fits_what_least_squares_fits(pipeline: Any) -> None:
    """The same torques, the same rows left out; W along the simulated motion of the truth is that
    of the measured one, up to noise."""
    made = loop(pipeline, "scara")
    W, b = DIDIM(rows="pipeline")._rows(
        made.experiment, made.experiment.simulate(made.source.truth.theta)
    )
    W_measured, b_measured = dense_rows(made.problem)
    np.testing.assert_allclose(b, b_measured, rtol=0, atol=1e-9 * np.abs(b).max())
    left_out = ~W_measured.any(axis=2)
    assert not W[left_out].any()
    assert not b[left_out].any()
    assert np.linalg.norm(W - W_measured) < 0.2 * np.linalg.norm(W)
    raw = DIDIM()._rows(made.experiment, made.experiment.simulate(made.source.truth.theta))[1]
    assert len(raw) == len(made.experiment.raw)


def test_didim_errs_less_on_the_rows_of_the_pipeline() -> None:
    """Where joints stick, sign(v) of all samples costs DIDIM its accuracy (mean over robots)."""
    ratios: dict[str, list[float]] = {"raw": [], "pipeline": []}
    for robot in ("scara", "ur3"):
        made = loop({"use": "parallel", "standstill": "5 %"}, robot)
        least = made.score(WLS(), WLS().solve(made.problem))["torque_error_moving"]
        for rows, found in ratios.items():
            method = DIDIM(rows=rows)
            scores = made.score(method, method.fit(made.experiment))
            found.append(scores["torque_error_moving"] / least)
    means = {rows: np.exp(np.log(found).mean()) for rows, found in ratios.items()}
    assert means["pipeline"] < 0.5 * means["raw"], means


def test_rows_of_didim_are_named() -> None:
    with pytest.raises(UsageError, match=r"'pipelin'.*pipeline"):
        DIDIM(rows="pipelin")
    with pytest.raises(UsageError, match="decimates its rows"):
        DIDIM(rows="pipeline", decimation=4)


# --- Bandwidth ----------------------------------------------------------------------------------


@pytest.mark.parametrize("robot", ["ur5", "scara"])
@pytest.mark.parametrize("harmonics", [2, 5])
@pytest.mark.parametrize("noise", [0.0, 1e-4])
def test_the_bandwidth_of_a_fourier_motion_is_its_highest_harmonic(
    robot: str, harmonics: int, noise: float
) -> None:
    written = {"use": "fourier", "harmonics": harmonics, "period": "4 s", "cycles": 2}
    motion = motion_of(robot_of(robot), written, 200.0, seed=3)
    q = motion.q + noise * np.random.default_rng(1).normal(size=motion.q.shape)
    assert 0.7 * harmonics / 4 <= bandwidth(q, 200.0) <= harmonics / 4 + 0.5


def test_what_does_not_move_has_no_bandwidth() -> None:
    assert bandwidth(np.ones((100, 2)), 100.0) == 0.0
    assert bandwidth(np.ones((100, 2)) * np.arange(100)[:, None], 100.0) == 0.0


@pytest.mark.parametrize("rate", [50.0, 250.0, 1000.0])
def test_rows_are_decimated_to_about_the_cutoff(rate: float) -> None:
    made = loop({"use": "parallel", "cutoff": "5 Hz"}, rate=rate, simulation={"use": "inverse"})
    kept = made.problem.samples / len(made.experiment.recording) * rate
    assert 2 * 5.0 <= kept <= 2 * 2.5 * 5.0


# --- Choice -------------------------------------------------------------------------------------


def test_settings_of_signals_are_those_of_plain() -> None:
    signals = {"filter": "average 5", "derivatives": "from q", "runs": "AB"}
    assert pipeline_of(None, signals) == build(
        "pipeline", {"use": "plain", "filter": "average 5", "derivatives": "from q"}
    )
    own = pipeline_of({"use": "plain", "filter": "none"}, signals)
    assert own == build("pipeline", {"use": "plain", "filter": "none", "derivatives": "from q"})
    with pytest.raises(UsageError, match="parallel"):
        pipeline_of({"use": "paralel"}, {})


# --- Scores -------------------------------------------------------------------------------------


def test_the_error_of_moving_joints_is_that_of_their_rows() -> None:
    made = loop(None, held_out=({"use": "ptp"},))
    beta = WLS().solve(made.problem).beta
    row = made.score(WLS(), WLS().solve(made.problem))
    (problem,), (moving,) = made.held_out.values(), made.held_out_moving.values()
    W, b = (np.concatenate(x) for x in zip(*problem.blocks(), strict=True))
    kept = np.any(np.concatenate([block for block, _ in moving.blocks()]), axis=2)
    assert 0.1 < 1 - kept.mean() < 0.9  # point-to-point motions rest
    error, size = (b - W @ beta) * kept, b * kept
    relative = np.linalg.norm(error, axis=0) / np.linalg.norm(size, axis=0)
    assert row["torque_error_moving"] == pytest.approx(np.sqrt((relative**2).mean()))
    every = np.linalg.norm(b - W @ beta, axis=0) / np.linalg.norm(b, axis=0)
    rms = np.sqrt((b**2).mean(axis=0))
    assert row["torque_error"] == pytest.approx(np.sqrt((every**2).mean()))
    assert row["torque_error_weighted"] == pytest.approx(np.sqrt(np.average(every**2, weights=rms)))
