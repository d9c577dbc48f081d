"""Recorded robot with its training and test recordings, and the Cramer-Rao bound of predictions at
the noise that a repeated motion shows."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final

import numpy as np

from sysid_bench.apps.twins.agreement import Residual, residual_correlation_time
from sysid_bench.apps.twins.effect_selection import processed_recording
from sysid_bench.apps.twins.fit_twin import Twin, without_effects
from sysid_bench.apps.twins.replay import Replay
from sysid_bench.errors import EstimationError
from sysid_bench.evaluation.cramer_rao import torque_bound
from sysid_bench.experiments.experiment_data import ExperimentData
from sysid_bench.experiments.recorded.prepare import LogOptions, build_problems, prepare_recordings
from sysid_bench.experiments.recorded.source import RecordedSource, predict_log, repetition_torque
from sysid_bench.identification.identify import identify
from sysid_bench.models.manifest import Manifest
from sysid_bench.plugin_names import build
from sysid_bench.signals.log_description import LogDescription
from sysid_bench.types import Array
from sysid_bench.words import FINDINGS

Posed = ExperimentData[RecordedSource]

METHOD: Final = "wls"
"""Method whose residuals are compared."""


@dataclass(frozen=True, eq=False)
class RecordedRobot:
    """Logs of a robot and how they are processed."""

    manifest: Manifest
    training: tuple[LogDescription, ...]
    tests: Mapping[str, LogDescription]
    options: LogOptions

    @cached_property
    def problems(self) -> Posed:
        """The problems of the logs; raises UsageError where they cannot be used."""
        return prepare_recordings(self.manifest, self.training, self.tests, self.options)

    def replay(self, plant: Replay, rate: float, seed: int) -> Posed:
        """Return the problems of replays of all logs by a plant, processed as the logs are.

        Each log has noise of its own, from the seed. Raises SimulationError, UsageError or
        UnsupportedError where the plant cannot follow the motions.
        """
        source, has_rates = self.problems.source, self.training[0].v is not None
        plant, preprocessing = replace(plant, has_rates=has_rates), source.builder.preprocessing
        again = [
            plant.along(
                processed_recording(log, preprocessing), rate, seed * len(source.recordings) + k
            )
            for k, log in enumerate(source.recordings)
        ]
        count = len(source.training)
        tests = dict(zip(source.tests, again[count:], strict=True))
        # A plant is what it is: its replays are not doubted.
        options = replace(self.options, accept=FINDINGS)
        return prepare_recordings(self.manifest, again[:count], tests, options)

    def without_effects(self, found: Twin) -> Posed:
        """Return the problem of the training logs without the torque of a twin's effects, and no
        tests: bodies can be fitted to the rest."""
        source = self.problems.source
        preprocessing = source.builder.preprocessing
        logs = without_effects(found, source.training, preprocessing)
        return build_problems(logs, {}, preprocessing, self.options)


def estimate_base(posed: Posed, method: str) -> Array:
    """Return the base parameters (r,) that a method finds; raises EstimationError if it fails."""
    estimate = identify(build("estimator", method), posed.problem, posed.experiment)
    if estimate.status != "ok" or estimate.beta is None:
        raise EstimationError(f"{method}: {estimate.reason}")
    return estimate.beta


def residual_of(posed: Posed, method: str = METHOD) -> list[Residual]:
    """Return the residual of a method on each test."""
    beta = estimate_base(posed, method)
    found = [predict_log(posed, beta, label) for label in posed.held_out]
    residuals = []
    for one in found:
        rate = float(1.0 / np.median(np.diff(one.t)))
        residuals.append(Residual(one.measured - one.predicted, one.measured, rate, one.t))
    return residuals


def repeat_bound(recorded: RecordedRobot) -> float | None:
    """Return the smallest torque error with which an unbiased fit of the training recordings can
    predict the test, were noise the only error; None where the test repeats no training motion.

    The noise of a joint is the difference of its torque at equal states of both recordings, over
    sqrt(2), taken as a first-order process. RMS over joints of the deviation of the prediction over
    the RMS torque.
    """
    posed = prepare_recordings(
        recorded.manifest,
        recorded.training,
        recorded.tests,
        replace(recorded.options, pipeline=None),
    )
    noise = _noise(posed)
    if noise is None:
        return None
    std, correlation = noise
    covariance = torque_bound((W for W, _ in posed.problem.blocks()), np.diag(std**2), correlation)
    if covariance is None:
        return None
    test = next(iter(posed.held_out.values()))
    variances = np.concatenate(
        [np.einsum("nij,jk,nik->ni", W, covariance, W) for W, _ in test.blocks()]
    )
    assert test.torque is not None
    return float(np.sqrt(np.mean(variances.mean(axis=0) / test.torque**2)))


def _noise(posed: Posed) -> tuple[Array, float] | None:
    """Standard deviations (rows,) and the correlation of consecutive samples; None without a
    repetition."""
    source, rows = posed.source, posed.problem.rows
    test = next(iter(source.tests.values()), None)
    found = None if test is None else repetition_torque(source.training, test, rows)
    if test is None or found is None:
        return None
    apart = (
        found - test.recording.tau[:, [test.robot.torque_rows.index(r) for r in rows]]
    ) / 2**0.5
    rate = test.recording.rate
    times = [residual_correlation_time(column, rate) for column in apart.T]
    seconds = float(np.exp(np.mean(np.log(times))))
    return np.maximum(apart.std(axis=0), 1e-9), float(np.exp(-1.0 / (rate * seconds)))
