"""Identification of one robot, from its own simulation or from recordings."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from sysid_bench.errors import UsageError
from sysid_bench.verbs.identify_recorded import RecordedRequest, identify_recorded
from sysid_bench.verbs.identify_result import IdentifyResult
from sysid_bench.verbs.identify_simulated import SimulatedRequest, identify_simulated
from sysid_bench.verbs.task_terms import check_term_names

PathLike = str | Path


def identify(
    model: PathLike,
    task: str = "robot",
    payload: str | Mapping[str, Any] = "none",
    terms: Sequence[str] | None = None,
    estimator: str | None = None,
    noise: Mapping[str, Any] | None = None,
    *,
    log: PathLike | Sequence[PathLike] = (),
    test: PathLike | Sequence[PathLike] = (),
    simulate: bool | None = None,
    model_out: PathLike | None = None,
    json_out: PathLike | None = None,
    robots_dir: Path | None = None,
    seed: int = 0,
    sensor: str | None = None,
    free_base: bool | None = None,
    contacts: Sequence[str] | str | None = None,
    complete: str | None = None,
    filter: str | None = None,
    derivatives: str | None = None,
    moving: float = 0.0,
    choose: Sequence[str] = (),
    position_given: bool = False,
    accept: Sequence[str] = (),
    figure: PathLike | None = None,
) -> IdentifyResult:
    """Identify a robot: from the recordings `log`, judged on `test`, or from its own simulation.

    See `SimulatedRequest` for payload, noise, seed, sensor, free_base, contacts and complete, and
    `RecordedRequest` for filter, derivatives, moving, choose, position_given, accept and figure.
    `model_out`: the model file again, with the identified values; `json_out`: the result as a file.
    Raises UsageError for unknown names or contradictory data, ModelError for a model that cannot be
    used or values that must not be written, EstimationError where the method fails.
    """
    check_term_names(terms)
    terms = None if terms is None else tuple(terms)
    logs, tests = _paths(log), _paths(test)
    of_logs = {
        "test": tests, "accept": accept, "choose": choose, "position-given": position_given,
        "filter": filter, "derivatives": derivatives, "moving": moving, "figure": figure,
    }  # fmt: skip
    of_simulation = {
        "noise": noise, "payload": payload != "none", "sensor": sensor, "contacts": contacts,
        "complete": complete,
    }  # fmt: skip
    _check_source(simulate, logs, of_simulation, of_logs)
    result: IdentifyResult
    if logs:
        result = identify_recorded(
            RecordedRequest(
                model=str(model),
                logs=logs,
                tests=tests,
                task=task,
                terms=terms,
                estimator=estimator,
                filter=filter,
                derivatives=derivatives,
                moving=moving,
                choose=tuple(choose),
                position_given=position_given,
                accept=tuple(accept),
                model_out=_path(model_out),
                json_out=_path(json_out),
                figure=_path(figure),
                robots_dir=robots_dir,
            )
        )
    else:
        result = identify_simulated(
            SimulatedRequest(
                model=str(model),
                task=task,
                payload=payload,
                terms=terms,
                estimator=estimator,
                noise=noise,
                seed=seed,
                sensor=sensor,
                free_base=free_base,
                contacts=contacts,
                complete=complete,
                model_out=_path(model_out),
                json_out=_path(json_out),
                robots_dir=robots_dir,
            )
        )
    if json_out is not None:
        text = json.dumps(result.to_dict(), indent=2) + "\n"
        Path(json_out).write_text(text, encoding="utf-8")
    return result


def _check_source(
    simulate: bool | None,
    logs: tuple[Path, ...],
    of_simulation: Mapping[str, Any],
    of_logs: Mapping[str, Any],
) -> None:
    """Raise UsageError without one source of data, and for options of the other one."""
    if (simulate is False and not logs) or (simulate and logs):
        raise UsageError(
            "Where do the data come from? Give --log LOG.toml for a recording, or --simulate for "
            "the robot's simulation."
        )
    foreign = [name for name, value in (of_simulation if logs else of_logs).items() if value]
    if not foreign:
        return
    names = ", ".join(f"--{name}" for name in foreign)
    if logs:
        raise UsageError(
            f"{names}: for simulated data only (--simulate). A log states its payload, and holds "
            "positions and torques without a force/torque sensor."
        )
    raise UsageError(f"{names}: for recordings only (--log).")


def _paths(files: PathLike | Sequence[PathLike]) -> tuple[Path, ...]:
    return (Path(files),) if isinstance(files, (str, Path)) else tuple(map(Path, files))


def _path(file: PathLike | None) -> Path | None:
    return None if file is None else Path(file)
