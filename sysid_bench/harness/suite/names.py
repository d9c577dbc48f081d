"""Look-up of the names in a suite: robots, payloads, tasks, plug-ins.

Third-party code is imported here (`default_names`), in a worker process of its own (see
harness/worker_names.py), or not at all: `static_names` reads its source (--no-code).
"""

import ast
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sysid_bench import plugin_names
from sysid_bench.errors import SysidBenchError, UsageError, unknown_name
from sysid_bench.input_files import read_data
from sysid_bench.models.data_sets import SCHEME, find_dataset
from sysid_bench.models.manifest import Manifest, find_manifest
from sysid_bench.models.model_record import ModelRecord, check_name, model_record
from sysid_bench.models.payload import Payload, parse_payload
from sysid_bench.models.sources import check_model_file

if TYPE_CHECKING:
    from sysid_bench.experiments.tasks.task import TaskDefinition


@dataclass(frozen=True)
class CheckedName:
    """Information that planning reads of a name that is looked up elsewhere, or was before."""

    name: str
    free_base: bool = False
    mass: float = 0.0
    supports_recordings: bool = True


def _task(name: str, folder: Path | None) -> "TaskDefinition":
    from sysid_bench.experiments.tasks.task import find_task

    return find_task(name, folder)


@dataclass(frozen=True)
class Names:
    """Functions that look names up, and raise an error of sysid_bench.errors for unknown ones.

    `robot(source, folder)`, `payload(name or table)`, `plugin(kind, {use, settings})`, which builds
    the object and so checks its settings (a metric is returned, or its record), `sensor(source,
    folder, text)`, which cuts the robot at each of the named sensors, `task(name, folder)`, and
    `model(source, folder, free_base)`: hash and behaviour of a robot that is here, and
    `content(text or table, folder)`: hashes of the files of a motion or a log, by their paths.
    """

    robot: Callable[[str, Path | None], Manifest | CheckedName]
    payload: Callable[[str | Mapping[str, Any]], Payload | CheckedName]
    plugin: Callable[[str, Mapping[str, Any]], object]
    sensor: Callable[[str, Path | None, str], object] = lambda source, folder, text: None
    task: "Callable[[str, Path | None], TaskDefinition | CheckedName]" = _task
    model: Callable[[str, Path | None, bool | None], ModelRecord | None] = (
        lambda source, folder, free_base: None
    )
    content: Callable[[str | Mapping[str, Any], Path], Mapping[str, str]] = lambda text, folder: {}
    frozen: bool = False  # nothing is looked up: the suite was checked before


def default_names(robots_dir: Path | None = None) -> Names:
    """Return the names of this installation, with robots of `robots_dir` first."""

    def robot(source: str, folder: Path | None) -> Manifest | CheckedName:
        if source.startswith(SCHEME):  # of a set that need not be here yet
            return CheckedName(find_dataset(source.removeprefix(SCHEME), folder).described.name)
        manifest = find_manifest(source, robots_dir, folder)
        if manifest.text is None:
            check_model_file(manifest.path)
        check_name(manifest)
        return manifest

    def sensor(source: str, folder: Path | None, text: str) -> object:
        from sysid_bench.models.load import load_robot  # loads MuJoCo
        from sysid_bench.models.sensor import sensor_names, subtree_at

        manifest, names = find_manifest(source, robots_dir, folder), sensor_names(text)
        if set(names) <= {sensor.name for sensor in manifest.sensors}:
            return names  # known from the manifest, without loading the model
        # A place that is not in the manifest: only the model knows its joints, sites and bodies.
        loaded = load_robot(manifest)
        return [subtree_at(loaded, name, ()) for name in names]

    def model(source: str, folder: Path | None, free_base: bool | None) -> ModelRecord | None:
        return model_record(source, robots_dir, folder, free_base)

    def content(written: str | Mapping[str, Any], folder: Path) -> Mapping[str, str]:
        from sysid_bench.signals.log_content import content_of  # loads SciPy

        return content_of(written, folder)

    return Names(robot, parse_payload, plugin_names.build, sensor, model=model, content=content)


def no_names() -> Names:
    """Return names that accept every word: a frozen suite was checked when it was planned."""

    def plugin(kind: str, spec: Mapping[str, Any]) -> None:
        if "use" not in spec:
            raise UsageError(f"A {kind} needs a name: {{ use = ... }}; got {sorted(spec)}.")

    return Names(
        robot=lambda source, folder: CheckedName(source),
        payload=lambda spec: CheckedName(str(spec)),
        plugin=plugin,
        task=lambda name, folder: CheckedName(name),
        frozen=True,
    )


def name_error(error: BaseException) -> str:
    """Return the message of a failed look-up; errors of plug-ins with their type."""
    if isinstance(error, SysidBenchError):
        return str(error)
    return f"importing or making it raised {type(error).__name__}: {error}"


def static_names(robots_dir: Path | None = None) -> Names:
    """Return the names of this installation; of third-party plug-ins, only that the file is there
    and defines the object is checked, not the settings."""
    own = default_names(robots_dir)

    def plugin(kind: str, spec: Mapping[str, Any]) -> object:
        use = spec.get("use")
        if not isinstance(use, str) or not plugin_names.is_third_party(kind, use):
            return own.plugin(kind, spec)
        definition = _definition(kind, use)
        return _metric_record(use, definition) if kind == "metric" else None

    def task(name: str, folder: Path | None) -> "TaskDefinition | CheckedName":
        use = str(plugin_names.resolve_files({"use": name}, folder)["use"])
        if not plugin_names.is_third_party("task", use):
            return own.task(name, folder)
        definition = _definition("task", use)
        for statement in definition.body if isinstance(definition, ast.ClassDef) else ():
            value = getattr(statement, "value", None)
            if "supports_recordings" in _names_of(statement) and isinstance(value, ast.Constant):
                return CheckedName(name, supports_recordings=value.value is not False)
        return CheckedName(name)  # a base class may set it

    return replace(own, plugin=plugin, task=task)


def _definition(kind: str, use: str) -> ast.stmt | None:
    """Return the statement that defines the object of a name; None where no source shows it.

    Raises UsageError where the module or the object is absent.
    """
    attribute = plugin_names.known(kind).get(use, use).rpartition(":")[2]
    file = plugin_names.source_file(kind, use)
    if file is None:
        raise UsageError(f"The file of the {kind.replace('_', '-')} {use!r} does not exist.")
    if file.suffix != ".py":
        return None  # compiled
    try:
        # Parsed and not imported: --no-code executes nothing of a suite.
        tree = ast.parse(read_data(file), str(file))
    except (OSError, ValueError, SyntaxError, RecursionError, MemoryError) as error:
        raise UsageError(f"{str(file)!r} is not valid Python: {error}.") from error
    names = {name: one for one in _statements(tree.body) for name in _names_of(one)}
    if names.keys().isdisjoint((attribute, "*", "__getattr__")):
        raise unknown_name(f"object in {str(file)!r}", attribute, names)
    # None for `*` and __getattr__: the object may be there, but no statement shows it.
    return names.get(attribute)


def _statements(block: list[ast.stmt]) -> Iterator[ast.stmt]:
    """Yield the statements of a module, those under `if`, `try` and `with` included."""
    for statement in block:
        yield statement
        if isinstance(statement, (ast.If, ast.Try, ast.With, ast.For, ast.While)):
            for name in ("body", "orelse", "finalbody"):
                yield from _statements(getattr(statement, name, []))
            for handler in getattr(statement, "handlers", []):
                yield from _statements(handler.body)


def _names_of(statement: ast.stmt) -> Iterator[str]:
    """Yield the names that a statement binds."""
    if isinstance(statement, (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef)):
        yield statement.name
    elif isinstance(statement, (ast.Import, ast.ImportFrom)):
        yield from (alias.asname or alias.name for alias in statement.names)
    elif isinstance(statement, (ast.Assign, ast.AnnAssign, ast.AugAssign)):
        targets = statement.targets if isinstance(statement, ast.Assign) else [statement.target]
        nodes = chain.from_iterable(map(ast.walk, targets))
        yield from (node.id for node in nodes if isinstance(node, ast.Name))


def _metric_record(use: str, definition: ast.stmt | None) -> dict[str, Any]:
    """Record of a metric from the literals of its call Metric(name, title, ...)."""
    calls = ast.walk(definition) if definition is not None else ()
    for node in (node for node in calls if isinstance(node, ast.Call)):
        function = node.func
        if "Metric" not in (getattr(function, "attr", None), getattr(function, "id", None)):
            continue
        values = dict(zip(("name", "title", "unit", "better"), node.args, strict=False))
        values |= {word.arg: word.value for word in node.keywords if word.arg}
        record = {}
        for key, value in values.items():
            with suppress(ValueError):  # not a literal, as the function `compute`
                record[key] = ast.literal_eval(value)
        if {"name", "title"} <= record.keys():
            return record
    raise UsageError(
        f"The name and title of the metric {use!r} are not literals of Metric(...) in its "
        "definition; plan without --no-code, or write record = { name = ..., title = ... }."
    )
