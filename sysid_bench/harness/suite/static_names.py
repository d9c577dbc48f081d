"""Names whose third-party plug-ins are looked up in their source, without running any of it."""

import ast
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any

from sysid_bench import plugin_names
from sysid_bench.errors import UsageError, unknown_name
from sysid_bench.harness.suite.names import Names, PlannedTask, default_names
from sysid_bench.input_files import read_data

Block = list[ast.stmt]


def static_names(robots_dir: Path | None = None) -> Names:
    """Return the names of this installation; of third-party plug-ins, only that the file is there
    and defines the object is checked, not the settings."""
    own = default_names(robots_dir)
    return replace(own, plugin=partial(_plugin, own), task=partial(_task, own))


@dataclass(frozen=True)
class _Task:
    supports_recordings: bool


def _plugin(own: Names, kind: str, spec: Mapping[str, Any]) -> object:
    use = spec.get("use")
    if not isinstance(use, str) or not plugin_names.is_third_party(kind, use):
        return own.plugin(kind, spec)
    definition = _definition(kind, use)
    return _metric_record(use, definition) if kind == "metric" else None


def _task(own: Names, name: str, folder: Path | None) -> PlannedTask:
    use = str(plugin_names.resolve_files({"use": name}, folder)["use"])
    if not plugin_names.is_third_party("task", use):
        return own.task(name, folder)
    found = _literal(_definition("task", use), "supports_recordings")
    return _Task(supports_recordings=found is not False)  # a base class may set it


def _definition(kind: str, use: str) -> ast.stmt | None:
    """Return the statement that defines the object of a name; None where no source shows it.

    Raises UsageError where the module or the object is absent.
    """
    attribute = plugin_names.known(kind).get(use, use).rpartition(":")[2]
    file = plugin_names.source_file(kind, use)
    if file is None:
        raise UsageError(f"There is no file of the {kind.replace('_', '-')} {use!r}.")
    if file.suffix != ".py":
        return None  # compiled
    statements = list(_statements(_syntax(file).body))
    names = {name: statement for statement in statements for name in _names_of(statement)}
    if names.keys().isdisjoint((attribute, "*", "__getattr__")):
        raise unknown_name(f"object in {str(file)!r}", attribute, names)
    return names.get(attribute)


def _syntax(file: Path) -> ast.Module:
    try:
        return ast.parse(read_data(file), str(file))
    except (OSError, ValueError, SyntaxError, RecursionError, MemoryError) as error:
        raise UsageError(f"{str(file)!r} is not valid Python: {error}.") from error


def _statements(block: Block) -> Iterator[ast.stmt]:
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
    else:
        nodes = chain.from_iterable(map(ast.walk, _targets(statement)))
        yield from (node.id for node in nodes if isinstance(node, ast.Name))


def _targets(statement: ast.stmt) -> list[ast.expr]:
    """Return the left sides of an assignment; nothing for another statement."""
    if isinstance(statement, ast.Assign):
        return statement.targets
    if isinstance(statement, (ast.AnnAssign, ast.AugAssign)):
        return [statement.target]
    return []


def _literal(definition: ast.stmt | None, name: str) -> object:
    """Value that a class body assigns to a name; None for any other than a literal."""
    for statement in definition.body if isinstance(definition, ast.ClassDef) else []:
        value = getattr(statement, "value", None)
        if name in _names_of(statement) and isinstance(value, ast.Constant):
            return value.value
    return None


def _metric_record(use: str, definition: ast.stmt | None) -> dict[str, Any]:
    """Record of a metric from the literals of its call Metric(name, title, ...)."""
    for node in ast.walk(definition) if definition is not None else ():
        if isinstance(node, ast.Call) and _called(node.func) == "Metric":
            record = dict(_literals(node))
            if {"name", "title"} <= record.keys():
                return record
    raise UsageError(
        f"The name and title of the metric {use!r} are not literals of Metric(...) in its "
        "definition; plan without --no-code, or write record = { name = ..., title = ... }."
    )


def _called(function: ast.expr) -> str:
    return str(getattr(function, "attr", None) or getattr(function, "id", ""))


def _literals(call: ast.Call) -> Iterator[tuple[str, Any]]:
    positional = zip(("name", "title", "unit", "better"), call.args, strict=False)
    named = ((word.arg, word.value) for word in call.keywords if word.arg not in (None, "compute"))
    for name, value in (*positional, *named):
        with suppress(ValueError):  # not a literal
            yield str(name), ast.literal_eval(value)
