"""Laws of the methods that simulate on recordings: declared controllers, measured torques."""

from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sysid_bench.commands.identify import identify
from sysid_bench.errors import EstimationError, UsageError
from sysid_bench.experiments.experiment_data import ExperimentData
from sysid_bench.experiments.recorded.prepare import LogOptions, prepare_recordings
from sysid_bench.experiments.simulated.source import SimulatedSource
from sysid_bench.signals.log_description import read_description
from tests.experiments.experiment_world import ready
from tests.signals.logs import Recorded, write

pytestmark = pytest.mark.long  # simulations by the hundred

SHORT = {"use": "fourier", "period": "3 s", "cycles": 1}
LOOP = {"use": "closed-loop", "rate": "1 kHz"}
CLOSED = ("iv", "clie", "cloe")
LONG = pytest.mark.long
ROLLOUT = {"use": "rollout", "horizon": 0.1}


@cache
def loop(robot: str) -> ExperimentData[SimulatedSource]:
    """A closed loop without noise."""
    return ready(robot=robot, simulation=LOOP, excitation=SHORT, rate=200.0, prior="none")


def controlled(folder: Path, robot: str, **changed: Any) -> Path:
    """Its recording as a file, with the commanded positions and the gains."""
    made = loop(robot)
    raw = made.experiment.raw
    assert raw.commanded is not None
    assert raw.controller is not None
    each, k = round(raw.controller.rate / raw.rate), len(raw.rows)
    # The columns of v hold the commanded positions.
    log = Recorded(raw.rows, raw.t, raw.q, raw.commanded.q[::each], raw.tau)
    gains = {name: getattr(raw.controller, name).tolist() for name in ("kp", "kd")}
    keys = {
        "v": None,
        "q_ref": {"columns": list(range(2 + k, 2 + 2 * k))},
        "controller": {**gains, "rate": "1 kHz", "held": raw.controller.held},
        **changed,
    }
    return write(folder, log, **keys)


def fitted(path: Path, robot: str, estimator: str, **options: Any) -> Any:
    terms = loop(robot).robot.manifest.terms
    return identify(robot, log=path, estimator=estimator, terms=terms, **options)


@pytest.mark.parametrize("estimator", ["iv", *(pytest.param(x, marks=LONG) for x in CLOSED[1:])])
def test_a_declared_controller_serves_the_methods_that_need_one(
    tmp_path: Path, estimator: str
) -> None:
    found = fitted(controlled(tmp_path, "scara"), "scara", estimator)
    assert found["std_from"] is not None
    # Positions under stiff gains hardly depend on the inertias: CLOE is the least accurate.
    assert max(joint["relative"] for joint in found["training"].values()) < 0.06


def test_the_declared_loop_makes_the_recorded_torque_again(tmp_path: Path) -> None:
    made = loop("scara")
    truth = made.source.truth
    log = read_description(controlled(tmp_path, "scara"))
    options = LogOptions(terms=made.robot.manifest.terms)
    posed = prepare_recordings(made.robot.manifest, [log], {}, options)
    at = [truth.parameters.index(name) for name in posed.problem.parameters]
    again = posed.experiment.simulate(truth.theta[at])
    late = again.t > 0.5  # the recorded robot does not start on the reference
    size = np.sqrt((made.experiment.raw.tau**2).mean(axis=0))
    error = np.sqrt(((again.tau - made.experiment.raw.tau)[late] ** 2).mean(axis=0))
    assert (error < 0.05 * size).all()


@pytest.mark.parametrize("estimator", CLOSED)
def test_without_a_controller_they_name_the_key(tmp_path: Path, estimator: str) -> None:
    path = controlled(tmp_path, "scara", controller=None)  # q_ref alone is not read
    with pytest.raises(EstimationError, match=r"controller = \{.*q_ref"):
        fitted(path, "scara", estimator)


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"q_ref": None}, "q_ref"),
        ({"controller": {"kp": [-1.0], "kd": [1.0]}}, "controller.kp must be positive"),
        ({"controller": {"kp": [1.0], "kd": [1.0], "rate": "430 Hz"}}, "multiple of the log"),
        ({"controller": {"kp": [1.0, 2.0], "kd": [1.0]}}, "controller.kp has 2 numbers"),
        ({"controller": {"kp": [1.0]}}, "controller.kd is missing"),
        ({"controller": {"kp": [1.0], "kd": [1.0], "gain": 3}}, "controller.gain"),
    ],
)
def test_mistakes_in_a_controller_are_named(
    tmp_path: Path, changed: dict[str, Any], words: str
) -> None:
    path = controlled(tmp_path, "scara", **changed)
    with pytest.raises(UsageError, match=words):
        fitted(path, "scara", "wls")


def test_features_cannot_be_simulated_and_are_named(tmp_path: Path) -> None:
    path = controlled(tmp_path, "scara")
    with pytest.raises(EstimationError, match="tanh"):
        identify("scara", log=path, estimator="cloe", terms=("viscous", "tanh"))


@pytest.mark.parametrize("estimator", [ROLLOUT, "ml", pytest.param("ekf", marks=LONG)])
def test_measured_torques_drive_the_methods_without_a_controller(
    tmp_path: Path, estimator: Any
) -> None:
    """Friction, standstill at the turns and a model file that knows neither."""
    made = loop("scara")
    raw = made.experiment.raw
    rng = np.random.default_rng(0)
    noisy = raw.tau + 0.01 * np.abs(raw.tau).max(axis=0) * rng.normal(size=raw.tau.shape)
    log = Recorded(raw.rows, raw.t, raw.q, np.gradient(raw.q, raw.t, axis=0), noisy)
    path = write(tmp_path, log)
    found = fitted(path, "scara", estimator)
    plain = fitted(path, "scara", "wls")
    assert found["rmse_train"] < 3 * plain["rmse_train"]


def test_a_feasible_estimate_has_deviations_or_a_reason(tmp_path: Path) -> None:
    path = controlled(tmp_path, "scara", controller=None)
    plain = fitted(path, "scara", "wls")
    found = fitted(path, "scara", "lmi")
    assert found["std_from"] == "blocks"
    assert "part" in found["std_limit"]
    stds = [entry["std"] for entry in found["base"]]
    known = [std for std in stds if std is not None]
    assert len(known) >= 0.5 * len(plain["base"])
    assert all(std > 0 for std in known)
