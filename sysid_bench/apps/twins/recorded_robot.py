"""Recorded robot with its training and test recordings, and the Cramer-Rao bound of predictions at
the noise that a repeated motion shows."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass, replace
from functools import cached_property
from multiprocessing import get_context
from pathlib import Path
from typing import Final, TypeVar

import numpy as np

from sysid_bench import package_folders
from sysid_bench.apps.twins.agreement import Residual, geometric_mean, residual_correlation_time
from sysid_bench.apps.twins.effect_selection import processed_recording
from sysid_bench.apps.twins.fit_twin import Twin, without_effects
from sysid_bench.apps.twins.replay import Replay
from sysid_bench.errors import EstimationError, UsageError
from sysid_bench.evaluation.cramer_rao import torque_bound
from sysid_bench.experiments.experiment_data import ExperimentData
from sysid_bench.experiments.recorded.prepare import LogOptions, build_problems, prepare_recordings
from sysid_bench.experiments.recorded.source import RecordedSource, predict_log, repetition_torque
from sysid_bench.identification.identify import identify
from sysid_bench.models.data_sets import SCHEME, find_dataset, is_dataset
from sysid_bench.models.manifest import Manifest, find_manifest
from sysid_bench.models.sources import source_settings
from sysid_bench.plugin_names import build
from sysid_bench.signals.log_data import LogLike, log_list
from sysid_bench.signals.log_description import LogDescription, find_description, log_description
from sysid_bench.signals.pipeline_choice import DEFAULT
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
        # Seeds of a replay and of its logs never overlap: no two of them share noise.
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
    posed = replace(recorded, options=replace(recorded.options, pipeline=None)).problems
    source, rows = posed.source, posed.problem.rows
    log = next(iter(source.tests.values()), None)
    found = None if log is None else repetition_torque(source.training, log, rows)
    if log is None or found is None:
        return None
    rate, columns = log.recording.rate, [log.robot.torque_rows.index(row) for row in rows]
    # The difference of two recordings has the noise of both.
    apart = (found - log.recording.tau[:, columns]) / 2**0.5
    seconds = geometric_mean([residual_correlation_time(column, rate) for column in apart.T])
    # The decay of a first-order process from one sample to the next. Repetitions show noise alone:
    # what both motions share, such as friction that the model lacks, cancels.
    std, correlation = np.maximum(apart.std(axis=0), 1e-9), float(np.exp(-1.0 / (rate * seconds)))
    covariance = torque_bound((W for W, _ in posed.problem.blocks()), np.diag(std**2), correlation)
    if covariance is None:
        return None
    test = next(iter(posed.held_out.values()))
    # W C W' of each test row: the variance of its predicted torque.
    variances = np.concatenate(
        [np.einsum("nij,jk,nik->ni", W, covariance, W) for W, _ in test.blocks()]
    )
    assert test.torque is not None
    return float(np.sqrt(np.mean(variances.mean(axis=0) / test.torque**2)))


def recorded_set(
    model: str,
    log: LogLike | Sequence[LogLike] = (),
    test: LogLike | Sequence[LogLike] = (),
    accept: tuple[str, ...] = (),
    robots_dir: Path | None = None,
) -> RecordedRobot:
    """Return a robot and its logs: `model` with `log` to fit and `test` to judge on, or the name or
    the folder of a data set, which has both. `accept`: contradictions in recordings that may pass.

    Raises UsageError for names and files that do not exist.
    """
    logs, tests = log_list(log, "log"), log_list(test, "test")
    if tests and not logs:
        raise UsageError(
            "--test names recordings to judge on, and there is none to fit: give --log run.toml, "
            f"too, or leave --test out, and the recordings of the data set {model!r} are used."
        )
    if logs:
        return RecordedRobot(
            find_manifest(model, robots_dir),
            tuple(map(find_description, logs)),
            {f"test {k}" if k else "test": find_description(log) for k, log in enumerate(tests)},
            LogOptions(pipeline={"use": DEFAULT}, accept=accept),
        )
    name, settings = source_settings(model)
    if name not in package_folders.dataset_files() and not is_dataset(name):
        raise UsageError(
            f"Which recordings of {model!r}? Give --log run.toml, and --test other.toml to "
            "judge on, or the name of a data set: sysid-bench list datasets."
        )
    found = of_data_set(name, accept, robots_dir)
    return replace(found, manifest=replace(found.manifest, **settings))


def of_data_set(
    name: str, accept: tuple[str, ...] = (), robots_dir: Path | None = None
) -> RecordedRobot:
    """Return the robot of a data set with its logs; raises UsageError for an unknown name."""
    described, place = find_dataset(name).described, f"{SCHEME}{name}"
    options = LogOptions(
        pipeline=described.pipeline or {"use": DEFAULT}, accept=(*described.accept, *accept)
    )
    return RecordedRobot(
        find_manifest(place, robots_dir),
        tuple(log_description(f"{place}/{log}", Path()) for log in described.train),
        {log: log_description(f"{place}/{log}", Path()) for log in described.test},
        options,
    )


Found = TypeVar("Found")


def run_work(work: Mapping[str, Callable[[], Found]], jobs: int) -> Iterator[tuple[str, Found]]:
    """Yield the name and the result of each piece of work as it is done, in `jobs` processes; with
    one job in this process and in order."""
    if jobs == 1:
        yield from ((name, one()) for name, one in work.items())
        return
    with ProcessPoolExecutor(jobs, get_context("spawn")) as pool:
        waiting = {pool.submit(one): name for name, one in work.items()}
        yield from ((waiting[done], done.result()) for done in as_completed(waiting))
