"""Values that a shell completes, by kind: names of an installation, which are kept in the user's
cache, and what changes from one moment to the next: names of files, runs, cells.

Only `os` is imported: a shell waits for the answer.
"""

import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from importlib import import_module

from sysid_bench.commands.stored import stored

_PACKAGE = os.path.dirname(os.path.dirname(os.path.abspath(__file__)))
_PLAN = "plan.jsonl"
_PLACES = (".", "reports", "runs")
_ID = b'{"id": "'
_ID_LETTERS = 12
_MOST = 500
"""Entries of a folder that are looked at for runs."""


def names_of(kind: str, word: str, arguments: Sequence[str]) -> list[str]:
    """Return the names of a kind, some of which begin with a word that was begun; `arguments`: what
    stands before it. "files" and "folders" are the shell's."""
    changing = list(CHANGING[kind](word, arguments)) if kind in CHANGING else []
    if kind in CHANGING and kind != "plants":  # plants are files, and plug-ins as well
        return changing
    return changing + stored("words", _words)[kind]


def _words() -> dict[str, list[str]]:
    """Words that only an installation changes, by kind; made once, in a second."""
    return dict(import_module("sysid_bench.commands.completion_words").words_by_kind())


def run_folders(word: str, arguments: Sequence[str] = ()) -> list[str]:
    """Return the run folders here, in reports/ and runs/, and beside what was begun."""
    beside = os.path.dirname(word)
    places = dict.fromkeys((*_PLACES, beside) if beside else _PLACES)
    return [name for place in places for name in _runs_in(place)]


def _runs_in(place: str) -> Iterator[str]:
    for entry in _entries(os.path.expanduser(place))[:_MOST]:
        if os.path.isfile(os.path.join(entry.path, _PLAN)):
            yield entry.name if place == "." else f"{place}/{entry.name}"


def cells(word: str, arguments: Sequence[str]) -> list[str]:
    """Return the ids of the cells of a run, the first of `arguments`."""
    if not arguments:
        return []
    path = os.path.join(os.path.expanduser(arguments[0]), _PLAN)
    begin = _ID + word.encode()
    try:
        with open(path, "rb") as lines:
            return [_cell_id(line) for line in lines if line.startswith(begin)]
    except OSError:
        return []


def _cell_id(line: bytes) -> str:
    return line[len(_ID) : len(_ID) + _ID_LETTERS].decode(errors="replace")


def tables(word: str, arguments: Sequence[str]) -> list[str]:
    """Return the names of the tables that a run has written."""
    folder = os.path.join(os.path.expanduser(arguments[0]), "tables") if arguments else ""
    return list(_stems(folder, ".md")) if folder else []


def robots(word: str, arguments: Sequence[str] = ()) -> list[str]:
    """Return the robots that have a name, of ./robots and of the installation."""
    return [
        entry.name
        for folder in _data_folders("robots")
        for entry in _entries(folder)
        if os.path.isfile(os.path.join(entry.path, "robot.toml"))
    ]


def _named(kind: str) -> Callable[[str, Sequence[str]], list[str]]:
    """Names of the TOML files of a kind, in its folder here and that of the installation."""
    return lambda word, arguments: [
        name for folder in _data_folders(kind) for name in _stems(folder, ".toml")
    ]


def _data_folders(kind: str) -> Iterator[str]:
    yield kind
    for place in (_PACKAGE, os.path.dirname(_PACKAGE)):
        yield os.path.join(place, kind)
        yield os.path.join(place, "data", kind)


def _stems(folder: str, suffix: str) -> Iterator[str]:
    names = (entry.name for entry in _entries(folder))
    return (name.removesuffix(suffix) for name in names if name.endswith(suffix))


def _entries(folder: str) -> list["os.DirEntry[str]"]:
    try:
        with os.scandir(folder or ".") as entries:
            return sorted(entries, key=lambda entry: entry.name)
    except OSError:
        return []


CHANGING: Mapping[str, Callable[[str, Sequence[str]], Iterable[str]]] = {
    "runs": run_folders,
    "cells": cells,
    "tables": tables,
    "robots": robots,
    "suites": _named("suites"),
    "datasets": _named("datasets"),
    "collections": _named("collections"),
    "plants": _named("plants"),
}
"""Values of each kind from the word that was begun and the arguments before it."""
