"""Answer to a shell that asks how a command line goes on."""

import os
import re
import shlex
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

from sysid_bench.completion.stored_words import stored_words
from sysid_bench.completion.values import CHANGING

Verb = Mapping[str, Any]

_QUOTES = "\"'"
_SPECIAL = re.compile(r"([^\w@%+=:,./~\n-])")


def answer(shell: str, line: str) -> None:
    """Print how a command line (up to the cursor) goes on, a word on each line: for zsh and fish
    with a tab and what it is, for bash without what bash itself takes for earlier words."""
    words, word, quote = line_words(line)
    spec = stored_words()
    found = dict(candidates(spec, words[1:], word))
    if shell == "bash":
        text = completed_text(found, word, quote)
    else:
        text = "\n".join(f"{name}\t{title}" if title else name for name, title in found.items())
    if text:
        print(text)


def line_words(line: str) -> tuple[list[str], str, str]:
    """Return the whole words of a line, the word at its end, and the quote that it is in."""
    reader = shlex.shlex(line, posix=True, punctuation_chars=False)
    reader.whitespace_split, reader.commenters = True, ""
    for quote in ("", '"', "'"):
        try:
            words = shlex.split(line + quote, comments=False)
        except ValueError:
            continue
        is_begun = bool(words) and _is_within_word(line, quote)
        return (words[:-1], words[-1], quote) if is_begun else (words, "", quote)
    return [], "", ""


def _is_within_word(line: str, quote: str) -> bool:
    """True where the last word of a line may go on."""
    return bool(quote) or not line[-1:].isspace() or line.endswith("\\ ")


def completed_text(names: Iterable[str], word: str, quote: str) -> str:
    """Return words as bash inserts them, a line each (one text: a run has tens of thousands of
    cells): bash replaces what follows the last of = and : alone."""
    begun = max(word.rfind(mark) for mark in os.environ.get("SYSID_BENCH_BREAKS", "=:"))
    start = word[: begun + 1]
    text = "\n".join(name.removeprefix(start) for name in names)
    return text if quote else _SPECIAL.sub(r"\\\1", text)


def candidates(
    spec: Mapping[str, Any], words: Sequence[str], word: str
) -> Iterator[tuple[str, str]]:
    """Yield (word, what it is) of everything that may stand in place of the last word."""
    verb, arguments, waiting = _position(spec["verb"], words)
    if waiting is not None:
        yield from _values(spec, waiting, word, arguments)
    elif word.startswith("--") and "=" in word:
        name, _, value = word.partition("=")
        values = _values(spec, verb["options"].get(name, {}), value, arguments)
        yield from ((f"{name}={one}", title) for one, title in values)
    elif word.startswith("-"):
        yield from _titles(verb["options"], word)
    else:
        yield from _titles(verb["verbs"], word)
        yield from _values(spec, _argument(verb, len(arguments)), word, arguments)


def _titles(named: Mapping[str, Any], word: str) -> Iterator[tuple[str, str]]:
    """(name, title) of the options or verbs that begin with a word."""
    return ((name, one["title"]) for name, one in named.items() if name.startswith(word))


def _position(verb: Verb, words: Sequence[str]) -> tuple[Verb, list[str], Mapping[str, Any] | None]:
    """The verb, the arguments so far, and the option whose value comes next."""
    arguments: list[str] = []
    waiting: Mapping[str, Any] | None = None
    for word in words:
        if waiting is not None:
            waiting = None
        elif word in verb["options"]:
            option = verb["options"][word]
            waiting = option if option["takes_value"] else None
        elif word in verb["verbs"]:
            verb, arguments = verb["verbs"][word], []
        elif not word.startswith("-"):
            arguments.append(word)
    return verb, arguments, waiting


def _argument(verb: Verb, number: int) -> Mapping[str, Any]:
    """Kinds of values of an argument; the last one may stand several times."""
    known = verb["arguments"]
    if number < len(known):
        return dict(known[number])
    return dict(known[-1]) if known and known[-1]["several"] else {}


def _values(
    spec: Mapping[str, Any], param: Mapping[str, Any], word: str, arguments: Sequence[str]
) -> Iterator[tuple[str, str]]:
    """Values of an option or argument; those separated by commas go on after the last comma."""
    before, comma, last = word.rpartition(",") if param.get("listed") else ("", "", word)
    return (
        (f"{before}{comma}{value}", title)
        for value, title in _known_values(spec, param, last, arguments)
        if value.startswith(last)
    )


def _known_values(
    spec: Mapping[str, Any], param: Mapping[str, Any], word: str, arguments: Sequence[str]
) -> Iterator[tuple[str, str]]:
    """(value, what it is) of each kind of an option or argument, then its choices."""
    for kind in param.get("kinds", ()):
        changing = CHANGING[kind](word, arguments) if kind in CHANGING else ()
        for value in (*changing, *spec["words"].get(kind, ())):
            yield value, kind.removesuffix("s")
    for value in param.get("choices", ()):
        yield value, ""
