"""Look-up of the names in a suite: robots, payloads, tasks, plug-ins."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Protocol

from sysid_bench import plugin_names
from sysid_bench.errors import SysidBenchError, UsageError
from sysid_bench.models.data_sets import SCHEME, find_dataset
from sysid_bench.models.manifest import find_manifest
from sysid_bench.models.payload import parse_payload


class Robot(Protocol):
    """The part of a manifest that planning reads."""

    @property
    def name(self) -> str: ...
    @property
    def free_base(self) -> bool: ...


class Load(Protocol):
    """The part of a payload that planning reads."""

    @property
    def name(self) -> str: ...
    @property
    def mass(self) -> float: ...


class PlannedTask(Protocol):
    """The part of a task that planning reads."""

    @property
    def supports_recordings(self) -> bool: ...


def _task(name: str, folder: Path | None) -> PlannedTask:
    from sysid_bench.experiments.tasks.task import find_task

    return find_task(name, folder)


@dataclass(frozen=True)
class Names:
    """Functions that look names up, and raise an error of sysid_bench.errors for unknown ones.

    `robot(source, folder)`, `payload(name or table)`, `plugin(kind, {use, settings})`, which builds
    the object and so checks its settings (a metric is returned, or its record), `sensor(source,
    folder, text)`, which cuts the robot at each of the named sensors, and `task(name, folder)`.
    """

    robot: Callable[[str, Path | None], Robot]
    payload: Callable[[str | Mapping[str, Any]], Load]
    plugin: Callable[[str, Mapping[str, Any]], object]
    sensor: Callable[[str, Path | None, str], object] = lambda source, folder, text: None
    task: Callable[[str, Path | None], PlannedTask] = _task
    frozen: bool = False  # nothing is looked up: the suite was checked before


def default_names(robots_dir: Path | None = None) -> Names:
    """Return the names of this installation, with robots of `robots_dir` first."""
    return Names(
        partial(_robot, robots_dir), _payload, plugin_names.build, partial(_sensor, robots_dir)
    )


def no_names() -> Names:
    """Return names that accept every word: a frozen suite was checked when it was planned."""
    return Names(_unseen_robot, _unseen_payload, _unseen_plugin, task=_unseen_task, frozen=True)


def name_error(error: BaseException) -> str:
    """Return the message of a failed look-up; errors of plug-ins with their type."""
    if isinstance(error, SysidBenchError):
        return str(error)
    return f"importing or making it raised {type(error).__name__}: {error}"


@dataclass(frozen=True)
class _Unseen:
    name: str
    free_base: bool = False
    mass: float = 0.0
    supports_recordings: bool = True


def _unseen_robot(source: str, folder: Path | None) -> Robot:
    return _Unseen(source)


def _unseen_payload(spec: str | Mapping[str, Any]) -> Load:
    return _Unseen(str(spec))


def _unseen_task(name: str, folder: Path | None) -> PlannedTask:
    return _Unseen(name)


def _unseen_plugin(kind: str, spec: Mapping[str, Any]) -> object:
    if "use" not in spec:
        raise UsageError(f"A {kind} needs a name: {{ use = ... }}; got {sorted(spec)}.")
    return None


def _robot(robots_dir: Path | None, source: str, folder: Path | None) -> Robot:
    if source.startswith(SCHEME):  # of a set that need not be here yet
        return _Unseen(find_dataset(source.removeprefix(SCHEME), folder).described.name)
    return find_manifest(source, robots_dir, folder)


def _sensor(robots_dir: Path | None, source: str, folder: Path | None, text: str) -> object:
    from sysid_bench.models.load import load_robot  # loads MuJoCo
    from sysid_bench.models.sensor import sensor_names, subtree_at

    manifest, names = find_manifest(source, robots_dir, folder), sensor_names(text)
    if set(names) <= {sensor.name for sensor in manifest.sensors}:
        return names  # known from the manifest, without loading the model
    robot = load_robot(manifest)
    return [subtree_at(robot, name, ()) for name in names]


def _payload(spec: str | Mapping[str, Any]) -> Load:
    return parse_payload(spec)
