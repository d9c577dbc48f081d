"""Identification of one robot, from its own simulation or from recordings."""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Final

from sysid_bench.commands.identify_recorded import RecordedRequest, identify_recorded
from sysid_bench.commands.identify_result import IdentifyResult
from sysid_bench.commands.task_terms import check_term_names
from sysid_bench.errors import UsageError, WriteError
from sysid_bench.experiments.tasks.task import find_task
from sysid_bench.models.sources import with_settings
from sysid_bench.signals.log_data import LogLike, log_list

PathLike = str | Path

OF_SIMULATION: Final = "for simulated data only (--simulate). A log states its payload itself."
OF_SENSOR: Final = "of a recording, for the task 'wrench' only: other tasks use joint torques."
OF_LOGS: Final = "for recordings only (--log)."
OF_DRIVES: Final = "for the task 'actuators' only."
"""Reasons why options do not fit the source of the data."""


def identify(
    model: PathLike, task: str = "robot", payload: str | Mapping[str, Any] = "none",
    terms: Sequence[str] | None = None, estimator: str | None = None,
    noise: Mapping[str, Any] | None = None, *, log: LogLike | Sequence[LogLike] = (),
    test: LogLike | Sequence[LogLike] = (), simulate: bool | None = None,
    model_out: PathLike | None = None, json_out: PathLike | None = None,
    robots_dir: Path | None = None, seed: int = 0, sensor: str | None = None,
    free_base: bool | None = None, contacts: Sequence[str] | str | None = None,
    complete: str | None = None, filter: str | None = None, derivatives: str | None = None,
    moving: float = 0.0, choose: Sequence[str] = (), position_given: bool = False,
    accept: Sequence[str] = (), figure: PathLike | None = None,
    pipeline: str | Mapping[str, Any] | None = None,
    prior: str | Mapping[str, Any] | None = None, feasible: str | None = None,
    share: Sequence[str] = (), also: Sequence[str] = (),
) -> IdentifyResult:  # fmt: skip
    """Identify a robot: from the recordings `log`, judged on `test`, or from its own simulation.

    A recording is the path of its description, or numbers in memory: see `sysid_bench.log_of`.
    The arguments are fields of `IdentifyRequest`, `SimulatedRequest` and `RecordedRequest`. Raises
    UsageError for unknown names or contradictory data, ModelError for a model that cannot be used
    or values that must not be written, EstimationError where the method fails.
    """
    logs, tests = _recordings(log, test, simulate)
    shared: dict[str, Any] = {
        "model": str(model), "task": task, "terms": _terms(terms), "estimator": estimator,
        "model_out": _path(model_out), "json_out": _path(json_out), "robots_dir": robots_dir,
        "pipeline": pipeline, "complete": complete, "sensor": sensor,
    }  # fmt: skip
    of_logs: dict[str, Any] = {
        "accept": tuple(accept), "choose": tuple(choose), "position_given": position_given,
        "share": tuple(share), "also": tuple(also), "filter": filter, "derivatives": derivatives,
        "moving": moving, "figure": _path(figure), **_given({"prior": prior, "feasible": feasible}),
    }  # fmt: skip
    of_simulation = {"noise": noise, "payload": payload, "contacts": contacts}
    if not logs:
        _refuse({"test": tests, **of_logs}, OF_LOGS)
        return _stored(partial(_from_simulation, shared | of_simulation, free_base, seed), json_out)
    _refuse({**of_simulation, "payload": payload != "none"}, OF_SIMULATION)
    shared |= {"logs": logs, "tests": tests, **of_logs}
    return _stored(partial(_from_recordings, shared, free_base, seed), json_out)


def _from_simulation(
    fields: Mapping[str, Any], free_base: bool | None, seed: int
) -> IdentifyResult:
    # Loading what simulates takes as long as a recording of 10 s takes to be identified.
    from sysid_bench.commands.identify_simulated import SimulatedRequest, identify_simulated

    return identify_simulated(SimulatedRequest(**fields, free_base=free_base, seed=seed))


def _from_recordings(
    fields: Mapping[str, Any], free_base: bool | None, seed: int
) -> IdentifyResult:
    """Identify the actuators or the bodies, by the task; raise UsageError for options of others."""
    task = find_task(fields["task"])
    if not task.measures_sensor_only:
        _refuse({"sensor": fields["sensor"]}, OF_SENSOR)
    model = with_settings(fields["model"], {"free_base": free_base})
    request = RecordedRequest(**{**fields, "model": model})
    if not task.identifies_drives:
        _refuse({"share": request.share, "also": request.also}, OF_DRIVES)
        return identify_recorded(request)
    _refuse({"seed": seed}, OF_SIMULATION)
    # Loading the engine that simulates takes as long as such a fit.
    from sysid_bench.commands.identify_actuators import identify_actuators

    return identify_actuators(request)


def _recordings(
    log: LogLike | Sequence[LogLike], test: LogLike | Sequence[LogLike], simulate: bool | None
) -> tuple[tuple[Any, ...], tuple[Any, ...]]:
    """Recordings to fit and to judge on; raise UsageError without one source of data."""
    logs, tests = log_list(log, "log"), log_list(test, "test")
    if (simulate is False and not logs) or (simulate and logs):
        raise UsageError(
            "Where do the data come from? Give --log LOG.toml for a recording, or --simulate for "
            "the robot's simulation."
        )
    return logs, tests


def _given(options: Mapping[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in options.items() if value is not None}


def _refuse(options: Mapping[str, Any], reason: str) -> None:
    """Raise UsageError for options of the other source of data."""
    given = [f"--{name}" for name, value in options.items() if value]
    if given:
        raise UsageError(f"{', '.join(given).replace('_', '-')}: {reason}")


def _stored(identified: Callable[[], IdentifyResult], file: PathLike | None) -> IdentifyResult:
    """Result, also written to the file `json_out`, which a model that is refused does not lose."""
    try:
        result = identified()
    except WriteError as error:
        if file is not None and isinstance(error.result, IdentifyResult):
            error.result.write_json(file)
        raise
    if file is not None:
        result.write_json(file)
    return result


def _terms(names: Sequence[str] | None) -> tuple[str, ...] | None:
    """Joint terms; raise UsageError for unknown ones, and for a single text."""
    check_term_names(names, features=True)
    return None if names is None else tuple(names)


def _path(file: PathLike | None) -> Path | None:
    return None if file is None else Path(file)
