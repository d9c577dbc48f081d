"""Keys of suites, robots and logs, from the tables that check them."""

import ast
import inspect
import io
import json
import textwrap
import tokenize
from collections.abc import Iterator, Mapping
from functools import cache
from itertools import zip_longest
from types import NoneType, UnionType
from typing import Annotated, Any, Final, Literal, NamedTuple, Union, get_args, get_origin

from pydantic import BaseModel
from pydantic.fields import FieldInfo
from pydantic_core import PydanticUndefined

from sysid_bench.harness.suite.checks import Choice, MetricChoice, Quantity, key_list, list_of
from sysid_bench.harness.suite.model import Suite
from sysid_bench.models.data_sets import DataSet
from sysid_bench.models.manifest import RobotKeys
from sysid_bench.reference.page import Section, Table, code, markdown_line, markdown_text
from sysid_bench.signals.log_keys import LogKeys

FILES: Final[Mapping[str, tuple[str, type[BaseModel]]]] = {
    "suite": ("Keys of a suite", Suite),
    "robot": ("Keys of robot.toml", RobotKeys),
    "log": ("Keys of a log description", LogKeys),
    "dataset": ("Keys of a data set", DataSet),
}
"""Title and keys of each kind of file, by the name of its page."""
_WORDS: Final[Mapping[Any, str]] = {
    str: "text",
    bool: "true or false",
    int: "whole number",
    float: "number",
    Any: "",
    NoneType: "",
}


class KeyTable(NamedTuple):
    """A table of a file: its heading as TOML writes it, and the model that checks it."""

    heading: str
    model: type[BaseModel]


def keys_page(name: str) -> Section:
    """Return the keys of a kind of file."""
    title, model = FILES[name]
    return Section(f"# {title}", *map(_section, key_tables(model)))


def _section(table: KeyTable) -> Section:
    heading = f"## `{table.heading}`" if table.heading else "## Top level"
    notes = key_notes(table.model)
    rows = [
        (
            code(field.alias or name), _values(field.annotation, field.metadata),
            _default(field), markdown_line(notes.get(name, "")),
        )
        for name, field in table.model.model_fields.items()
    ]  # fmt: skip
    if table.model.model_config.get("extra") == "allow":
        rows.append(("any other", "", "", "a setting of the plug-in, or a note"))
    words = markdown_text(str(table.model.__dict__.get("__doc__") or ""))
    return Section(heading, words, Table(("key", "value", "default", "meaning"), rows))


def _default(field: FieldInfo) -> str:
    """Default as code; nothing for no value, and for tables, whose keys have their own."""
    if field.is_required():
        return "required"
    value = field.default
    if isinstance(value, tuple) and len(value) == 1:
        (value,) = value
    first = value[0] if isinstance(value, tuple) and value else value
    if isinstance(first, BaseModel) or value in (PydanticUndefined, None, (), {}):
        return ""
    return code(json.dumps(value, ensure_ascii=False))


def key_tables(model: type[BaseModel]) -> list[KeyTable]:
    """Return the tables of a file in the order of its keys, each model once."""
    found = [KeyTable("", model)]
    # The list grows while it is read: inner tables follow their outer ones.
    for outer in found:
        for name, field in outer.model.model_fields.items():
            path = ".".join(filter(None, (outer.heading.strip("[]"), field.alias or name)))
            for inner, is_list in _models(field.annotation, False):
                # A sweep is a tuple for pydantic, and a single table for who writes it.
                is_list = is_list and not _is_sweep(field.metadata)
                if all(other.model is not inner for other in found):
                    found.append(KeyTable(f"[[{path}]]" if is_list else f"[{path}]", inner))
    return found


def _models(annotation: Any, is_list: bool) -> Iterator[tuple[type[BaseModel], bool]]:
    """Models in an annotation, and whether they stand in a list."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation, is_list
    for part in get_args(annotation):
        yield from _models(part, is_list or get_origin(annotation) is tuple)


def _is_sweep(metadata: Any) -> bool:
    return any(getattr(one, "func", None) in (list_of, key_list) for one in metadata)


def _values(annotation: Any, metadata: Any = ()) -> str:
    """Values of a key, as Markdown: those its check allows, else its type."""
    if _is_sweep(metadata):
        return " or ".join(filter(None, (_element(annotation), "a list: a sweep")))
    said = _said(metadata)
    if said is not None:
        return said
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
    is_model = isinstance(annotation, type) and issubclass(annotation, BaseModel)
    return "table" if is_model or origin in (dict, Mapping) else _WORDS.get(annotation, "")


def _said(metadata: Any) -> str | None:
    """Values by the first check that knows them; None where none does."""
    for check in metadata:
        match getattr(check, "func", None):
            case Quantity() as one:
                return markdown_line(one.words)
            case Choice() as one:
                return ", ".join(map(code, one.words))
            case MetricChoice() as one:
                return one.kind
    return None


def _element(annotation: Any) -> str:
    """Values of one element of a tuple, which may be missing."""
    parts = get_args(annotation)
    inner = next((part for part in parts if get_origin(part) is tuple), None)
    return _element(inner) if inner is not None else _values(parts[0]) if parts else ""


def key_notes(model: type[BaseModel]) -> dict[str, str]:
    """Return the meaning of each field: the comment behind it and the docstring below it."""
    notes: dict[str, str] = {}
    # A derived table may describe an inherited key anew.
    for base in reversed(model.__mro__):
        if issubclass(base, BaseModel) and base is not BaseModel:
            notes |= _own_notes(base)
    return notes


@cache
def _own_notes(model: type[BaseModel]) -> Mapping[str, str]:
    """Notes on the fields that a model defines itself; the syntax of its whole file is read."""
    # Comments are not in the syntax tree: lines of the tokens join both.
    source = textwrap.dedent(inspect.getsource(model))
    comments = {
        token.start[0]: token.string.lstrip("# ")
        for token in tokenize.generate_tokens(io.StringIO(source).readline)
        if token.type == tokenize.COMMENT
    }
    [cls] = ast.parse(source).body
    assert isinstance(cls, ast.ClassDef)
    notes = {}
    for node, below in zip_longest(cls.body, cls.body[1:]):
        if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
            lines = range(node.lineno, (node.end_lineno or node.lineno) + 1)
            words = [comments[line] for line in lines if line in comments]
            if isinstance(below, ast.Expr) and isinstance(below.value, ast.Constant):
                words.append(str(below.value.value))
            notes[node.target.id] = "; ".join(filter(None, words))
    return notes
