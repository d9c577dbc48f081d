"""A payload from a wrist sensor: as precise as white noise allows, and calibrated in situ."""

import numpy as np
import pytest

from sysid_bench.evaluation.score import score
from sysid_bench.identification.estimators.linear import WLS
from sysid_bench.identification.identify import identify
from sysid_bench.types import Array, Score
from tests.experiments.experiment_world import dense, ready

ARMS = ("ur3", "ur5", "ur10", "panda", "kinova", "xarm7", "z1", "baxter")
NOISE = {"force": 0.15, "moment": 0.008}
FAULTS = {
    "gain": 0.01, "crosstalk": 0.01, "mounting": float(np.deg2rad(0.5)),
    "force_offset": 1.0, "moment_offset": 0.05,
}  # fmt: skip
LOADS = [
    "none",
    {"mass": 1.0, "com": [0.1, 0.0, 0.05], "inertia": "sphere 0.05 m"},
    {"mass": 1.0, "com": [-0.05, 0.1, 0.1], "inertia": "sphere 0.05 m"},
]
REPEATS = 4


def _payload(robot: str, **changes: object):  # type: ignore[no-untyped-def]
    return ready(
        robot=robot, payload="box-2kg", task="wrench-payload", sensor="wrist", rate=100.0, **changes
    )


def _score(made) -> Score:  # type: ignore[no-untyped-def]
    return score(identify(WLS(), made.problem), made.problem, made.held_out, made.source.truth)


@pytest.mark.parametrize("robot", ARMS)
def test_white_noise_costs_no_more_than_the_bound(robot: str) -> None:
    """RMS error over repeats against the Cramer-Rao bound, ten numbers pooled."""
    first = _payload(robot, noise=NOISE)
    W, _ = dense(first.problem)
    G = (W / np.repeat([NOISE["moment"], NOISE["force"]], 3)[:, None]).reshape(-1, 10)
    bound = np.sqrt(np.diag(np.linalg.inv(G.T @ G)))
    errors: list[Array] = []
    for repeat in range(REPEATS):
        made = _payload(robot, noise=NOISE, repeat=repeat)
        beta = identify(WLS(iterations=3), made.problem).beta
        assert beta is not None
        errors.append((beta - made.problem.base.K @ made.source.truth.theta) / bound)
    assert 0.7 < np.sqrt(np.mean(np.square(errors))) < 1.3


@pytest.mark.parametrize("robot", ["ur5", "panda"])
def test_known_loads_calibrate_a_faulty_sensor(robot: str) -> None:
    plain = {"filter": "none", "derivatives": "exact"}
    better = plain | {"calibration": LOADS}
    errors = []
    for noise, signals in ((NOISE, plain), (NOISE | FAULTS, plain), (NOISE | FAULTS, better)):
        scores = [_score(_payload(robot, noise=noise, signals=signals, repeat=k)) for k in range(2)]
        errors.append([(one.mass_error, one.com_error, one.inertia_error) for one in scores])
    clean, faulty, calibrated = (np.median(np.array(e, dtype=float), axis=0) for e in errors)
    assert (faulty > 5 * clean).all()
    assert (calibrated < 0.5 * faulty).all()
