"""Pages of the Python API and of the JSON of results, from signatures and docstrings."""

import dataclasses
import inspect
import re
from collections.abc import Iterator
from importlib import import_module
from typing import Any, Final

from sysid_bench import types
from sysid_bench.commands.result import Result
from sysid_bench.reference.page_text import code, markdown_text, page, table

_MODULES: Final = re.compile(
    r"\b(?:sysid_bench|collections|typing|pathlib|numpy|pandas)(?:\.\w+)*\."
)
_SHORT: Final = 88
_PACKAGE: Final = import_module("sysid_bench")
"""By name: it imports this page for `help`, and type checkers would see a cycle."""


def package_page() -> str:
    """Return the functions and classes of `sysid_bench` and of `sysid_bench.types`."""
    own = (_object(f"sysid_bench.{name}", getattr(_PACKAGE, name)) for name in package_names())
    data = (_object(f"sysid_bench.types.{name}", thing) for name, thing in _public_types())
    return page("# Python API", *own, *data)


def result_page() -> str:
    """Return the fields of each result, which are the keys of the command's JSON."""
    parts = (
        page(f"## {code(name)}", markdown_text(thing.__doc__ or ""), _fields(thing)).strip()
        for name in package_names()
        if _is_result(thing := getattr(_PACKAGE, name))
    )
    return page("# JSON of results", *parts)


def package_names() -> list[str]:
    """Return the public names of `sysid_bench`."""
    return [name for name in _PACKAGE.__all__ if not name.startswith("_")]


def _public_types() -> Iterator[tuple[str, Any]]:
    """Yield (name, class) of the classes of `sysid_bench.types`."""
    for name, thing in vars(types).items():
        if inspect.isclass(thing) and thing.__module__ == types.__name__:
            yield name, thing


def _is_result(thing: Any) -> bool:
    return inspect.isclass(thing) and issubclass(thing, Result) and thing is not Result


def _object(name: str, thing: Any) -> str:
    text = markdown_text(thing.__doc__ or "")
    heading = f"## {code(name.rpartition('.')[2])}"
    if inspect.isclass(thing):
        return page(heading, f"```python\nclass {name}\n```", text, _fields(thing)).strip()
    return page(heading, f"```python\n{_call(name, thing)}\n```", text).strip()


def _call(name: str, function: Any) -> str:
    """Signature, with a line per argument where it is long."""
    signature = inspect.signature(function)
    answer = plain_types(inspect.formatannotation(signature.return_annotation)).strip('"')
    inner = signature.replace(return_annotation=inspect.Signature.empty)
    line = f"{name}{plain_types(str(inner))} -> {answer}"
    if len(line) <= _SHORT:
        return line
    arguments: list[str] = []
    is_keyword = False
    for argument in signature.parameters.values():
        if argument.kind is inspect.Parameter.KEYWORD_ONLY and not is_keyword:
            arguments, is_keyword = [*arguments, "*"], True
        arguments.append(plain_types(str(argument)))
    return f"{name}(\n" + "".join(f"    {one},\n" for one in arguments) + f") -> {answer}"


def plain_types(text: str) -> str:
    """Return types without the modules that they come from."""
    return _MODULES.sub("", text).replace("'", '"')


def _fields(thing: Any) -> str:
    """Fields of a record, with their types as written."""
    if not dataclasses.is_dataclass(thing):
        return ""
    rows = [(code(field.name), code(_type(field.type))) for field in dataclasses.fields(thing)]
    return table(("field", "type"), rows) if rows else ""


def _type(annotation: Any) -> str:
    text = annotation if isinstance(annotation, str) else inspect.formatannotation(annotation)
    return plain_types(text)
