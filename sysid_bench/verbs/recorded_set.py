"""Recordings of a robot for twins: those of a data set, or logs of one's own."""

from collections.abc import Sequence
from pathlib import Path

from sysid_bench import package_folders
from sysid_bench.data_sets.find_dataset import SCHEME, find_dataset, is_dataset
from sysid_bench.errors import UsageError
from sysid_bench.experiments.recorded.prepare import LogOptions
from sysid_bench.models.manifest import find_manifest
from sysid_bench.signals.log_description import LogDescription, log_description, read_description
from sysid_bench.signals.pipeline_choice import DEFAULT
from sysid_bench.twins.recorded_robot import RecordedRobot

Logs = Sequence[Path | LogDescription]


def recorded_set(
    model: str, logs: Logs, tests: Logs, accept: Sequence[str], robots_dir: Path | None
) -> RecordedRobot:
    """Return a robot with its logs; without any, `model` is a data set, which has both.

    Raises UsageError for names and files that do not exist.
    """
    if tests and not logs:
        raise UsageError(
            "--test names recordings to judge on, and there is none to fit: give --log run.toml, "
            f"too, or leave --test out, and the recordings of the data set {model!r} are used."
        )
    if logs:
        manifest = find_manifest(model, robots_dir)
        training = tuple(_described(log) for log in logs)
        found = {f"test {k}" if k else "test": _described(log) for k, log in enumerate(tests)}
        options = LogOptions(pipeline={"use": DEFAULT}, accept=tuple(accept))
        return RecordedRobot(manifest, training, found, options)
    return _of_set(model, accept, robots_dir)


def _of_set(model: str, accept: Sequence[str], robots_dir: Path | None) -> RecordedRobot:
    if model not in package_folders.dataset_files() and not is_dataset(model):
        raise UsageError(
            f"Which recordings of {model!r}? Give --log run.toml, and --test other.toml to judge "
            "on, or the name of a data set: sysid-bench list datasets."
        )
    described, place = find_dataset(model).described, f"{SCHEME}{model}"
    options = LogOptions(
        pipeline=described.pipeline or {"use": DEFAULT}, accept=(*described.accept, *accept)
    )
    return RecordedRobot(
        find_manifest(place, robots_dir),
        tuple(log_description(f"{place}/{name}", Path()) for name in described.train),
        {name: log_description(f"{place}/{name}", Path()) for name in described.test},
        options,
    )


def _described(log: Path | LogDescription) -> LogDescription:
    return log if isinstance(log, LogDescription) else read_description(log)
