"""A recorded robot with training and test motions, and the same experiment on its replays."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Final

import numpy as np

from sysid_bench.apps.twins.fit_twin import Twin, without_effects
from sysid_bench.apps.twins.joint_signals import processed_recording
from sysid_bench.apps.twins.replay import Replay
from sysid_bench.apps.twins.residual_figures import Residual
from sysid_bench.errors import EstimationError
from sysid_bench.experiments.experiment_data import ExperimentData
from sysid_bench.experiments.recorded.prepare import LogOptions, build_problems, prepare_recordings
from sysid_bench.experiments.recorded.process_log import ProcessedLog
from sysid_bench.experiments.recorded.source import RecordedSource, predict_log
from sysid_bench.identification.identify import identify
from sysid_bench.models.manifest import Manifest
from sysid_bench.plugin_names import build
from sysid_bench.signals.log_description import LogDescription
from sysid_bench.types import Array, Recording
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
        plant = replace(plant, has_rates=has_rates)
        again = [
            plant.along(self._tested(log), rate, seed * len(source.recordings) + k)
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

    def _tested(self, log: ProcessedLog) -> Recording:
        return processed_recording(log, self.problems.source.builder.preprocessing)


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
    return [_residual(one.measured, one.predicted, one.t) for one in found]


def _residual(measured: Array, predicted: Array, t: Array) -> Residual:
    rate: Any = 1.0 / np.median(np.diff(t))
    return Residual(measured - predicted, measured, float(rate), t)
