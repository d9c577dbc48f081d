"""Keys of suites, robots and logs, from the tables that check them."""

import ast
import inspect
import io
import json
import textwrap
import tokenize
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from types import NoneType, UnionType
from typing import Annotated, Any, Final, Literal, TypeGuard, Union, get_args, get_origin

from pydantic import BaseModel
from pydantic.fields import FieldInfo
from pydantic_core import PydanticUndefined

from sysid_bench.harness.suite.checks import Choice, MetricChoice, Quantity, key_list, list_of
from sysid_bench.harness.suite.model import Suite
from sysid_bench.models.data_sets import DataSet
from sysid_bench.models.manifest import RobotKeys
from sysid_bench.reference.page_text import code, markdown_line, markdown_text, page, table
from sysid_bench.signals.log_keys import LogKeys

HEADER: Final = ("key", "value", "default", "meaning")
_WORDS: Final[Mapping[Any, str]] = {
    str: "text",
    bool: "true or false",
    int: "whole number",
    float: "number",
    Any: "",
    NoneType: "",
}


@dataclass(frozen=True)
class _Section:
    """A table of a file: its heading as TOML writes it, and the model that checks it."""

    heading: str
    model: type[BaseModel]


FILES: Final[Mapping[str, tuple[str, type[BaseModel]]]] = {
    "suite": ("Keys of a suite", Suite),
    "robot": ("Keys of robot.toml", RobotKeys),
    "log": ("Keys of a log description", LogKeys),
    "dataset": ("Keys of a data set", DataSet),
}
"""Title and keys of each kind of file, by the name of its page."""


def keys_page(name: str) -> str:
    """Return the keys of a kind of file."""
    title, model = FILES[name]
    return _page(title, model)


def key_tables(model: type[BaseModel]) -> list[_Section]:
    """Return the tables of a file in the order of its keys, each model once."""
    found = [_Section("", model)]
    for section in found:
        for inner in _inner_sections(section):
            if all(other.model is not inner.model for other in found):
                found.append(inner)
    return found


def _inner_sections(section: _Section) -> Iterator[_Section]:
    """Yield the tables that the keys of a table hold."""
    for name, field in section.model.model_fields.items():
        for inner, is_list in _tables(field.annotation, False):
            is_list = is_list and not _is_sweep(field.metadata)
            yield _Section(_heading(section.heading, _key(name, field), is_list), inner)


def _page(title: str, model: type[BaseModel]) -> str:
    return page(f"# {title}", *(_section(section) for section in key_tables(model)))


def _section(section: _Section) -> str:
    heading = f"## `{section.heading}`" if section.heading else "## Top level"
    return page(
        heading, markdown_text(_own_doc(section.model)), table(HEADER, _rows(section.model))
    ).strip()


def _own_doc(model: type[BaseModel]) -> str:
    return str(model.__dict__.get("__doc__") or "")


def _heading(outer: str, key: str, is_list: bool) -> str:
    path = ".".join(filter(None, (outer.strip("[]"), key)))
    return f"[[{path}]]" if is_list else f"[{path}]"


def _key(name: str, field: FieldInfo) -> str:
    return field.alias or name


def _rows(model: type[BaseModel]) -> Iterator[tuple[str, ...]]:
    notes = key_notes(model)
    for name, field in model.model_fields.items():
        values = _values(field.annotation, field.metadata)
        yield code(_key(name, field)), values, _default(field), markdown_line(notes.get(name, ""))
    if model.model_config.get("extra") == "allow":
        yield "any other", "", "", "a setting of the plug-in, or a note"


def _checks(metadata: Iterable[Any]) -> list[Any]:
    """Functions by which a value is checked."""
    return [getattr(one, "func", None) for one in metadata]


def _is_sweep(metadata: Iterable[Any]) -> bool:
    return not {list_of, key_list}.isdisjoint(_checks(metadata))


def _is_model(annotation: Any) -> TypeGuard[type[BaseModel]]:
    return isinstance(annotation, type) and issubclass(annotation, BaseModel)


def _tables(annotation: Any, is_list: bool) -> Iterator[tuple[type[BaseModel], bool]]:
    """Models in an annotation, and whether they stand in a list."""
    if _is_model(annotation):
        yield annotation, is_list
    within = get_origin(annotation) is tuple
    for part in get_args(annotation):
        yield from _tables(part, is_list or within)


def _values(annotation: Any, metadata: Any = ()) -> str:
    """What a key takes, as Markdown."""
    if _is_sweep(metadata):
        return " or ".join(filter(None, (_element(annotation), "a list: a sweep")))
    checked = (_checked_values(check) for check in _checks(metadata))
    return next((values for values in checked if values is not None), None) or _of_type(annotation)


def _checked_values(check: Any) -> str | None:
    """Values that a check accepts; None where they are not known."""
    match check:
        case Quantity():
            return markdown_line(check.words)
        case Choice():
            return ", ".join(map(code, check.words))
        case MetricChoice():
            return check.kind
    return None


def _element(annotation: Any) -> str:
    """Values of one element of a tuple, which may be missing."""
    for part in get_args(annotation):
        if get_origin(part) is tuple:
            return _element(part)
    return _values(get_args(annotation)[0]) if get_args(annotation) else ""


def _of_type(annotation: Any) -> str:
    origin, parts = get_origin(annotation), get_args(annotation)
    if origin is Annotated:
        return _values(parts[0], parts[1:])
    if origin in (Union, UnionType):
        return " or ".join(dict.fromkeys(filter(None, map(_values, parts))))
    if origin is Literal:
        return ", ".join(code(json.dumps(value)) for value in parts)
    if origin is tuple:
        words = "tables" if _values(parts[0]) == "table" else _values(parts[0])
        return f"list of {words}".removesuffix(" of ")
    if origin in (dict, Mapping) or _is_model(annotation):
        return "table"
    return _WORDS.get(annotation, "")


def _default(field: FieldInfo) -> str:
    if field.is_required():
        return "required"
    value = field.default
    if isinstance(value, tuple) and len(value) == 1:
        (value,) = value
    return "" if _is_empty(value) else code(json.dumps(value, ensure_ascii=False))


def _is_empty(value: Any) -> bool:
    """True for a default of no value, and of tables, whose keys have their own."""
    first = value[0] if isinstance(value, tuple) and value else value
    return isinstance(first, BaseModel) or value in (PydanticUndefined, None, (), {})


def key_notes(model: type[BaseModel]) -> dict[str, str]:
    """Return the meaning of each field: the comment behind it and the docstring below it."""
    notes: dict[str, str] = {}
    for base in reversed(model.__mro__):
        if issubclass(base, BaseModel) and base is not BaseModel:
            notes |= _own_notes(base)
    return notes


@cache
def _own_notes(model: type[BaseModel]) -> Mapping[str, str]:
    """Notes on the fields that a model defines itself; the syntax of its whole file is read."""
    source = textwrap.dedent(inspect.getsource(model))
    comments = _comments(source)
    [cls] = ast.parse(source).body
    assert isinstance(cls, ast.ClassDef)
    notes = {}
    for node, following in zip(cls.body, [*cls.body[1:], None], strict=True):
        if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
            lines = range(node.lineno, (node.end_lineno or node.lineno) + 1)
            words = filter(None, map(comments.get, lines))
            notes[node.target.id] = "; ".join([*words, *_docstring(following)])
    return notes


def _docstring(node: ast.stmt | None) -> list[str]:
    value = node.value if isinstance(node, ast.Expr) else None
    return [str(value.value)] if isinstance(value, ast.Constant) else []


def _comments(source: str) -> dict[int, str]:
    """Comments by line."""
    return {
        token.start[0]: token.string.lstrip("# ")
        for token in tokenize.generate_tokens(io.StringIO(source).readline)
        if token.type == tokenize.COMMENT
    }
