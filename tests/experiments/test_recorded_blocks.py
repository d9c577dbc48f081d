"""Blocks of time of recordings: what repeats shares a block without a declared period."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sysid_bench.evaluation.covariance import standard_errors
from sysid_bench.experiments.recorded.prepare import LogOptions, prepare_recordings
from sysid_bench.identification.estimators.linear import WLS
from sysid_bench.identification.linear.cross_validation import block_labels
from sysid_bench.signals.log_description import read_description
from sysid_bench.types import Array, Problem
from tests.robots import named_robot
from tests.signals.logs import RATE, Recorded, recorded, write

SECONDS = 4.0


def repeated(robot: str, times: int) -> Recorded:
    """A log of some identical periods with noise of their own."""
    one = recorded(named_robot(robot), period=SECONDS)
    rng = np.random.default_rng(0)
    samples = round(SECONDS * RATE)

    def tiled(x: Array) -> Array:
        return np.tile(x[:samples], (times, 1))

    tau = tiled(one.tau)
    tau += 0.02 * tau.std(axis=0) * rng.normal(size=tau.shape)
    return Recorded(one.joints, np.arange(len(tau)) / RATE, tiled(one.q), tiled(one.v), tau)


def posed(folder: Path, robot: str, log: Recorded, pipeline: Any = None, **keys: Any) -> Problem:
    description = read_description(write(folder, log, **keys))
    options = LogOptions(pipeline=pipeline) if pipeline else LogOptions()
    manifest = named_robot(robot).manifest
    return prepare_recordings(manifest, [description], {}, options).problem


@pytest.mark.parametrize("pipeline", [None, {"use": "parallel"}])
@pytest.mark.parametrize("robot", ["scara", pytest.param("ur5", marks=pytest.mark.long)])
def test_a_period_that_is_not_declared_is_in_one_block(
    tmp_path: Path, robot: str, pipeline: Any
) -> None:
    samples = round(SECONDS * RATE)
    found = posed(tmp_path, robot, repeated(robot, 2), pipeline)
    assert found.period == 0
    step = round(2 * samples / found.samples)
    assert (step > 1) == (pipeline is not None)
    phase = np.arange(found.samples) * step % samples
    np.testing.assert_array_equal(block_labels(found, 5), phase * 5 // samples)


def test_a_repetition_that_is_found_is_no_period_of_intervals(tmp_path: Path) -> None:
    log = repeated("scara", 6)
    kinds = {}
    for name, keys in (("found", {}), ("declared", {"period": f"{SECONDS:g} s"})):
        problem = posed(tmp_path, "scara", log, **keys)
        kinds[name] = [*standard_errors(problem, WLS().solve(problem))]
    assert "periods" in kinds["declared"]
    assert "periods" not in kinds["found"]
