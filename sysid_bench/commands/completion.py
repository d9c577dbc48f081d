"""Verb `completion`: what makes a shell complete words. Its questions are answered by click, with
values by kind: names of an installation, which are kept in the user's cache, and what changes from
one moment to the next, as names of runs and cells.

A shell waits for the answer: registries are imported for the cache alone.
"""

import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Final

import click
from click.shell_completion import CompletionItem, get_completion_class

from sysid_bench import package_folders
from sysid_bench.commands.request import OK, Request, argument, option
from sysid_bench.commands.stored import stored
from sysid_bench.errors import UsageError, unknown_name

VARIABLE: Final = "_SYSID_BENCH_COMPLETE"
"""Variable in which a script asks, as click reads it."""
START_FILES: Final[Mapping[str, str]] = {
    "bash": "~/.bashrc",
    "zsh": "~/.zshrc",
    "fish": "~/.config/fish/config.fish",
}
"""File that each shell reads when it starts."""
_OF_SHELL: Final[Mapping[str, str]] = {"files": "file", "folders": "dir"}
"""Kinds that the shell itself completes, as click calls them."""


class Completion(Request[None]):
    """Print the script that completes verbs, options and names in a shell; default: this shell.

    `sysid-bench completion --install` switches it on.
    """

    has_json = False

    name: str | None = argument("[bash|zsh|fish]", default=None, complete="shells")
    install: bool = option("Switch it on in every new shell, by its start file.", default=False)

    def shell(self, as_json: bool) -> int:
        name = self.name or os.path.basename(os.environ.get("SHELL", ""))
        if name not in START_FILES:
            raise unknown_name("shell that completes", name, START_FILES)
        names_of("names", "", ())  # the first answer is as quick as the others
        if not self.install:
            click.echo(script(name).strip("\n"))
            return OK
        file = Path(START_FILES[name]).expanduser()
        line = f'eval "$(sysid-bench completion {name})"'
        if name == "fish":
            line = "sysid-bench completion fish | source"
        text = file.read_text(encoding="utf-8") if file.exists() else ""
        if line in text.splitlines():
            raise UsageError(f"{file} has the line already: {line}.")
        file.parent.mkdir(parents=True, exist_ok=True)
        with file.open("a", encoding="utf-8") as start:
            start.write(("" if text.endswith("\n") or not text else "\n") + line + "\n")
        click.echo(f"{file} has the line: {line}\nOpen a new shell, or run that line in this one.")
        return OK


def script(shell: str) -> str:
    """Return the script of a shell."""
    from sysid_bench.commands.main import main

    found = get_completion_class(shell)
    assert found is not None
    return found(main, {}, "sysid-bench", VARIABLE).source()


def completer(
    kinds: str, separated: bool
) -> Callable[[click.Context, click.Parameter, str], list[CompletionItem]]:
    """Return a function that completes values of kinds; after a comma the last one of a list."""

    def complete(ctx: click.Context, param: click.Parameter, word: str) -> list[CompletionItem]:
        # Shells replace the whole word: names are given with what stands before the last comma.
        before, comma, last = word.rpartition(",") if separated else ("", "", word)
        arguments = [str(x) for x in ctx.params.values() if isinstance(x, (str, os.PathLike))]
        found: list[CompletionItem] = []
        # Files first: click's script for bash forgets what stands before them.
        for kind in sorted(kinds.split(), key=lambda kind: kind not in _OF_SHELL):
            if kind in _OF_SHELL:
                found.append(CompletionItem(word, type=_OF_SHELL[kind]))
                continue
            names = (name for name in names_of(kind, last, arguments) if name.startswith(last))
            found += [CompletionItem(f"{before}{comma}{name}") for name in names]
        return found

    return complete


def names_of(kind: str, word: str, arguments: Sequence[str]) -> list[str]:
    """Return the names of a kind, some of which begin with a word that was begun; `arguments`: what
    stands before it. "files" and "folders" are the shell's."""
    changing = list(CHANGING[kind](word, arguments)) if kind in CHANGING else []
    if kind in CHANGING and kind != "plants":  # plants are files, and plug-ins as well
        return changing
    return changing + stored("words", words_by_kind)[kind]


# --- What changes -------------------------------------------------------------------------------

_PLAN = "plan.jsonl"
_ID = b'{"id": "'
_MOST = 500
"""Entries of a folder that are looked at for runs."""


def _runs(word: str, arguments: Sequence[str]) -> Iterator[str]:
    """Run folders here, in reports/ and runs/, and beside what was begun."""
    for place in dict.fromkeys((".", "reports", "runs", os.path.dirname(word) or ".")):
        # Not `stored_run.run_names`: its imports would take longer than the answer.
        folder = Path(place).expanduser()
        for entry in sorted(folder.iterdir())[:_MOST] if folder.is_dir() else ():
            if (entry / _PLAN).is_file():
                yield entry.name if place == "." else f"{place}/{entry.name}"


def _cells(word: str, arguments: Sequence[str]) -> list[str]:
    """Ids of the cells of a run, the first of `arguments`."""
    try:
        # Lines begin with the id, so that nothing is parsed: a plan may have a million of them.
        with (Path(arguments[0]).expanduser() / _PLAN).open("rb") as lines:
            begun = (line for line in lines if line.startswith(_ID + word.encode()))
            return [line[len(_ID) : len(_ID) + 12].decode(errors="replace") for line in begun]
    except (OSError, IndexError):
        return []


def _tables(word: str, arguments: Sequence[str]) -> list[str]:
    """Names of the tables that a run has written."""
    written = (Path(run).expanduser() / "tables" for run in arguments[:1])
    return [file.stem for folder in written for file in sorted(folder.glob("*.md"))]


def _files(find: Callable[[], Iterable[str]]) -> Callable[[str, Sequence[str]], Iterable[str]]:
    return lambda word, arguments: find()


CHANGING: Final[Mapping[str, Callable[[str, Sequence[str]], Iterable[str]]]] = {
    "runs": _runs,
    "cells": _cells,
    "tables": _tables,
    "robots": _files(package_folders.robots),
    "suites": _files(package_folders.suite_files),
    "datasets": _files(package_folders.dataset_files),
    "collections": _files(package_folders.collection_files),
    "plants": _files(package_folders.plant_files),
}
"""Values of each kind from the word that was begun and the arguments before it."""


# --- What an installation decides ---------------------------------------------------------------


def words_by_kind() -> dict[str, list[str]]:
    """Return the words that only an installation changes, by kind; made in a second."""
    from sysid_bench import plugin_names
    from sysid_bench.commands.catalogue import KINDS, WORDS
    from sysid_bench.commands.report import FORMATS
    from sysid_bench.metrics import METRICS
    from sysid_bench.models.payload import PAYLOADS
    from sysid_bench.reference.pages import title_by_page
    from sysid_bench.words import CELL_FIELDS, FINDINGS

    plugins = {
        f"{kind.replace('_', '-')}s": sorted(plugin_names.known(kind))
        for kind in plugin_names.BUILTIN
    }
    words = {
        **plugins,
        **{kind: list(words) for kind, words in WORDS.items()},
        "terms": [*WORDS["terms"], *plugins["terms"]],
        "metrics": sorted({*METRICS, *plugins["metrics"]}),
        "payloads": list(PAYLOADS),
        "executors": ["local", "dask://", "slurm:"],
        "findings": list(FINDINGS),
        "priors": ["model", "none"],
        "formats": list(FORMATS),
        "fields": sorted(CELL_FIELDS),
        "kinds": list(KINDS),
        "topics": list(title_by_page()),
        "shells": list(START_FILES),
        "truths": ["wls", "lmi"],
    }
    named = (*plugins, *WORDS, "payloads")
    return words | {"names": sorted({name for kind in named for name in words[kind]})}
