"""Recordings of a robot for twins: those of a data set, or logs of one's own."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from sysid_bench import package_folders
from sysid_bench.apps.twins.recorded_robot import RecordedRobot
from sysid_bench.errors import UsageError
from sysid_bench.experiments.recorded.prepare import LogOptions
from sysid_bench.models.data_sets import SCHEME, find_dataset, is_dataset
from sysid_bench.models.manifest import find_manifest
from sysid_bench.models.sources import source_settings
from sysid_bench.signals.log_data import LogLike, log_list
from sysid_bench.signals.log_description import find_description, log_description
from sysid_bench.signals.pipeline_choice import DEFAULT


@dataclass(frozen=True)
class RecordedChoice:
    """Recordings of a robot: `model` with `log` to fit and `test` to judge on, or the name or the
    folder of a data set, which has both. `accept`: contradictions in recordings that may pass."""

    model: str
    log: LogLike | Sequence[LogLike] = ()
    test: LogLike | Sequence[LogLike] = ()
    accept: tuple[str, ...] = ()
    robots_dir: Path | None = None


def recorded_set(choice: RecordedChoice) -> RecordedRobot:
    """Return a robot with its logs; raises UsageError for names and files that do not exist."""
    model, logs, tests = choice.model, log_list(choice.log, "log"), log_list(choice.test, "test")
    if tests and not logs:
        raise UsageError(
            "--test names recordings to judge on, and there is none to fit: give --log run.toml, "
            f"too, or leave --test out, and the recordings of the data set {model!r} are used."
        )
    if logs:
        return RecordedRobot(
            find_manifest(model, choice.robots_dir),
            tuple(map(find_description, logs)),
            {f"test {k}" if k else "test": find_description(log) for k, log in enumerate(tests)},
            LogOptions(pipeline={"use": DEFAULT}, accept=choice.accept),
        )
    return _of_named_set(choice)


def _of_named_set(choice: RecordedChoice) -> RecordedRobot:
    """A robot with the logs of the data set of its name."""
    name, settings = source_settings(choice.model)
    if name not in package_folders.dataset_files() and not is_dataset(name):
        raise UsageError(
            f"Which recordings of {choice.model!r}? Give --log run.toml, and --test other.toml to "
            "judge on, or the name of a data set: sysid-bench list datasets."
        )
    found = of_data_set(name, choice.accept, choice.robots_dir)
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
