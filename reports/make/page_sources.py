"""Dependencies of a part of a page: the code, suite, robots and library versions of its command.

Code counts as the modules that the command can import, read and not imported; comments, docstrings
and layout do not count.
"""

import ast
import functools
import re
import shlex
import tomllib
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, Final

from sysid_bench.canonical_json import canonical_hash
from sysid_bench.commands.table import find_verb
from sysid_bench.plugin_names import BUILTIN
from sysid_bench.version_fields import PACKAGES

ROOT: Final = Path(__file__).parents[2]
_PRINTING: Final = ("table", "claims", "figure", "report", "limits", "cells")
"""Verbs that print rows of a run, whose own part of the page states where the rows come from."""
_PRINTED_BY: Final = {"evaluation", "reporting", "metrics"}
_ROWS: Final = "sysid_bench.experiments.execute"  # the plan has a hash of its own in kept rows
_NO_SCORES: Final = {
    *("canonical_json", "errors", "extras", "package_folders", "plugin_names", "types"),
    *("version_fields", "words"),
}
"""Messages, names and formats."""
_NAMES: Final = {
    name: target.partition(":")[0] for kind in BUILTIN.values() for name, target in kind.items()
}
_C_COMMENT: Final = re.compile(r"/\*.*?\*/|//[^\n]*", re.DOTALL)


def sources(command: str, root: Path = ROOT) -> dict[str, str]:
    """Return digests by package, file of the suite, robot and file of versions, of what the output
    of a command depends on, in the checkout `root`."""
    first, *words = shlex.split(command)
    if first == "python":
        return _code((words[1],), root) | _data(root, ())
    verb, *rest = words
    if verb == "run":
        suite = f"suites/{rest[0].removeprefix('suites/').removesuffix('.toml')}.toml"
        content = _toml(root / suite)
        names = _strings(content)
        used = sorted({_NAMES[name] for name in names if name in _NAMES})
        return _code((_ROWS, *used), root) | _data(
            root, (suite, *_named(names, _strings((content or {}).get("log")), root))
        )
    found = find_verb(verb)
    code = _code((found.target.partition(":")[0],) if found else (), root)
    if verb in _PRINTING:
        return {room: digest for room, digest in code.items() if room in _PRINTED_BY}
    return code | _data(root, _named(rest, rest, root))


def changed(before: Mapping[str, str], now: Mapping[str, str]) -> set[str]:
    """Names that are new or different, folders of robots and files of data sets as one; absent ones
    where nothing else changed."""
    found = {name for name, digest in now.items() if before.get(name) != digest}
    return {name if name.startswith("suites/") else name.split("/")[0] for name in found} or {
        name for name in before if name not in now
    }


@functools.cache
def _code(modules: tuple[str, ...], root: Path) -> dict[str, str]:
    """Digests, by package, of the modules that these can import, themselves included."""
    seen = dict[str, str]()
    todo = list(modules)
    while todo:
        name = todo.pop()
        file = _file(name, root)
        # The package's own front imports every verb where types alone are checked.
        if file is None or name in seen or name == "sysid_bench":
            continue
        seen[name], imported = _module(file)
        todo += [name.rpartition(".")[0], *imported]
    rooms = dict[str, dict[str, str]]()
    for name, digest in seen.items():
        if (room := _room(name)) not in _NO_SCORES:
            rooms.setdefault(room, {})[name] = digest
    for room, files in rooms.items():
        folder = root / "sysid_bench" / room
        # The header of all compiled files, then those of the package and its tables.
        compiled = [*(root / "sysid_bench").glob("*.h"), *folder.rglob("*.c"), *folder.rglob("*.h")]
        files |= {c.name: _c_digest(c) for c in compiled}
        files |= {one.name: canonical_hash(_toml(one)) for one in folder.rglob("*.toml")}
    return {room: canonical_hash(files)[:8] for room, files in rooms.items()}


def _room(module: str) -> str:
    """ "identification" of "sysid_bench.identification.estimators.linear"; else the module."""
    first, *rest = module.split(".")
    return rest[0] if first == "sysid_bench" and rest else module


def _file(module: str, root: Path) -> Path | None:
    path = root / module.replace(".", "/")
    found = (path.with_suffix(".py"), path / "__init__.py")
    return next((file for file in found if file.is_file()), None)


@functools.cache
def _module(file: Path) -> tuple[str, tuple[str, ...]]:
    """Digest of a module and the names that it imports, wherever in it."""
    tree = ast.parse(file.read_bytes())
    imported = [name for node in _nodes(tree) for name in _imports(node)]
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef):
            node.body = [line for line in node.body if not _is_text(line)]
    return canonical_hash(ast.dump(tree)), tuple(imported)


def _nodes(node: ast.AST) -> Iterator[ast.AST]:
    """Yield the nodes below one, without what is read by type checkers alone."""
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.If) and ast.unparse(child.test) == "TYPE_CHECKING":
            continue
        yield child
        yield from _nodes(child)


def _imports(node: ast.AST) -> list[str]:
    if isinstance(node, ast.Import):
        return [one.name for one in node.names]
    if isinstance(node, ast.ImportFrom) and node.module:
        return [node.module, *(f"{node.module}.{one.name}" for one in node.names)]
    return []


def _is_text(line: ast.stmt) -> bool:
    return isinstance(line, ast.Expr) and isinstance(getattr(line.value, "value", None), str)


@functools.cache
def _c_digest(file: Path) -> str:
    return canonical_hash(" ".join(_C_COMMENT.sub(" ", file.read_text(encoding="utf-8")).split()))


@functools.cache
def _toml(file: Path) -> Any:
    return tomllib.loads(file.read_text(encoding="utf-8")) if file.is_file() else None


def _strings(value: Any) -> set[str]:
    """All strings of a value, however deep."""
    if isinstance(value, str):
        return {value}
    items = value.values() if isinstance(value, dict) else value
    return set().union(*map(_strings, items)) if isinstance(items, Iterable) else set()


def _named(names: Iterable[str], data_sets: Iterable[str], root: Path) -> list[str]:
    """Folders of robots, files of plants, with those that they are made of, and descriptions of
    data sets with one of these names."""
    found = [f"robots/{name}" for name in names] + [f"data/datasets/{n}.toml" for n in data_sets]
    plants, todo = set[str](), set(names)
    while todo:
        new = {f"data/plants/{name}.toml" for name in todo} - plants
        new = {path for path in new if re.fullmatch(r"[\w/.-]+", path) and (root / path).exists()}
        todo = set[str]().union(*(_strings(_toml(root / path)) for path in new))
        plants |= new
    found = [p for p in found if re.fullmatch(r"[\w/.-]+", p) and (root / p).exists()]
    return sorted({*found, *plants})


def _data(root: Path, paths: Iterable[str]) -> dict[str, str]:
    """Digests of files and folders, and of the pinned versions on which results depend."""
    pins = (root / "constraints.txt").read_text(encoding="utf-8").splitlines()
    kept = [pin for pin in pins if re.split(r"[=<>\[; ]", pin)[0] in PACKAGES]
    found = {"constraints.txt": canonical_hash(kept)[:8]}
    for path in paths:
        place = root / path
        if place.suffix == ".toml":
            found[path] = canonical_hash(_toml(place))[:8]
        else:
            files = [file for file in sorted(place.rglob("*")) if file.is_file()]
            parts = [(str(f.relative_to(place)), f.read_bytes().hex()) for f in files]
            found[path] = canonical_hash(parts)[:8]
    return found
