"""Answers of a method to data whose last bits differ: what depends on rounding alone."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from functools import partial
from typing import Any, Final

import numpy as np

from sysid_bench.canonical_json import plain
from sysid_bench.errors import reason_of, status_of
from sysid_bench.experiments.execute import estimator_of, load_experiment
from sysid_bench.experiments.experiment_data import ExperimentData
from sysid_bench.experiments.job_channel import JobChannel
from sysid_bench.experiments.prepare import prepare
from sysid_bench.identification.identify import fit_fields, identify
from sysid_bench.types import Array, Experiment, Problem, Recording, Row, RowBlock

SIZE: Final = 4.0 * float(np.finfo(float).eps)
"""Largest relative change of a value, four units of the last place of 1."""


def repeat_cells(
    argument: Mapping[str, Any], channel: JobChannel | None = None
) -> dict[str, list[Row]]:
    """Answers of the estimators of `argument["job"]` (see harness/job.py) by cell: to the data of
    their experiment, then to `argument["repeats"]` copies with other last bits (seeds 0, 1, ...).

    Raises UnsupportedError or UsageError for an experiment that cannot be made.
    """
    spec, loaded = load_experiment(argument["job"])
    data = prepare(spec, loaded)
    copies = [data.experiment]
    copies += [near_experiment(data.experiment, seed) for seed in range(argument["repeats"])]
    entries = argument["job"]["estimators"]
    return {entry["cell"]: [_answer(entry, data, copy) for copy in copies] for entry in entries}


def _answer(entry: Mapping[str, Any], data: ExperimentData[Any], given: Experiment) -> Row:
    """Status, end of the iterations and scores of a method on a copy of its data."""
    try:
        method = estimator_of(entry)
        estimate = identify(method, given.problem, given)
        scores = data.score(method, estimate)
    except Exception as error:  # of a plug-in, as in a run
        return {"status": status_of(error), "reason": reason_of(error)}
    row = {"status": estimate.status, **fit_fields(estimate)}
    return dict(plain(row | data.figures | scores))


def near_experiment(experiment: Experiment, seed: int) -> Experiment:
    """A copy of the data in which each measured value, entry of W and b and entry of the R factors
    is multiplied by 1 + `SIZE` u, u uniform between -1 and 1; zeros stay."""
    rng = np.random.default_rng(seed)
    return replace(
        experiment,
        problem=_problem(experiment.problem, rng),
        recording=_recording(experiment.recording, rng),
        raw=_recording(experiment.raw, rng),
        runs=tuple(
            replace(run, recording=_recording(run.recording, rng)) for run in experiment.runs
        ),
    )


def _problem(problem: Problem, rng: np.random.Generator) -> Problem:
    factors = tuple(replace(factor, R=_changed(factor.R, rng)) for factor in problem.factors)
    blocks = partial(_blocks, problem.blocks, int(rng.integers(2**32)))
    motions = tuple(_problem(motion, rng) for motion in problem.motions)
    return replace(problem, factors=factors, blocks=blocks, motions=motions)


def _blocks(blocks: Callable[[], Iterator[RowBlock]], seed: int) -> Iterator[RowBlock]:
    """Yield the blocks with other last bits, the same ones at each reading."""
    rng = np.random.default_rng(seed)
    for W, b in blocks():
        yield _changed(W, rng), _changed(b, rng)


def _recording(recording: Recording, rng: np.random.Generator) -> Recording:
    given = {name: getattr(recording, name) for name in ("q", "v", "a", "tau", "wrench")}
    changed: dict[str, Any] = {k: _changed(x, rng) for k, x in given.items() if x is not None}
    return replace(recording, **changed)


def _changed(values: Array, rng: np.random.Generator) -> Array:
    return np.asarray(values * (1.0 + SIZE * rng.uniform(-1.0, 1.0, np.shape(values))))
