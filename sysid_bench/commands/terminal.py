"""Print for the terminal that stdout is; what is piped stays Markdown or one line each."""

import json
import shutil
import sys
import textwrap
from collections.abc import Mapping, Sequence
from itertools import accumulate, chain
from typing import Any, Final

import click

from sysid_bench.canonical_json import plain
from sysid_bench.reporting.terminal import terminal_tables, terminal_text

_MOST_LINES: Final = 2
"""Lines of one title of a list; one where the screen is too small for two."""
_LEAST_HEIGHT: Final = 20
"""Lines that a list has at least before it is cut."""


def on_terminal() -> bool:
    """Return True where stdout is a terminal."""
    return sys.stdout.isatty()


def terminal_output(text: str) -> str:
    """Return text of results with its tables drawn where stdout is a terminal."""
    return terminal_tables(text, shutil.get_terminal_size().columns) if on_terminal() else text


def terminal_lines() -> int | None:
    """Return the rows of a table that fit on the screen; None where stdout is not a terminal."""
    return max(shutil.get_terminal_size().lines - 6, _LEAST_HEIGHT) if on_terminal() else None


def print_json(value: Any) -> None:
    """Print a value as JSON; NaN and infinities become null."""
    click.echo(json.dumps(plain(value), indent=2))


def print_result(result: Any, as_json: bool) -> None:
    """Print a result as JSON, or its summary; a value without one as JSON."""
    if as_json or not hasattr(result, "summary"):
        print_json(result)
    else:
        click.echo(terminal_output(result.summary()))


def print_table(text: str, form: str | None) -> None:
    """Print a table in a format that was asked for as it is, else for the screen."""
    drawn = text if form or not on_terminal() else f"{terminal_output(text)}\n"
    click.echo(drawn, nl=False)


def print_markdown(text: str) -> None:
    """Print Markdown, drawn for a terminal."""
    drawn = terminal_text(text, shutil.get_terminal_size().columns) if on_terminal() else text
    click.echo(drawn.rstrip("\n"))


def print_entries(entries: Sequence[Mapping[str, Any]], rest: str) -> None:
    """Print names with titles; on a terminal titles are wrapped and a list longer than the screen
    ends with a count and the command `rest` that prints all. An empty `rest` cuts nothing."""
    gap = max((len(entry["name"]) for entry in entries), default=0) + 2
    if not on_terminal():
        for entry in entries:
            click.echo(f"{entry['name']:<{gap}}{entry['title']}".rstrip())
        return
    size = shutil.get_terminal_size()
    height = max(size.lines - 2, _LEAST_HEIGHT) if rest else sys.maxsize
    blocks = [_lines(entry, gap, size.columns, _MOST_LINES) for entry in entries]
    if sum(map(len, blocks)) > height:
        blocks = [_lines(entry, gap, size.columns, 1) for entry in entries]
    ends = list(accumulate(map(len, blocks)))
    shown = sum(end <= height for end in ends)
    for line in chain.from_iterable(blocks[:shown]):
        click.echo(line)
    if shown < len(entries):
        click.echo(f"... and {len(entries) - shown} more of {len(entries)}; all: {rest}")


def _lines(entry: Mapping[str, Any], gap: int, width: int, most: int) -> list[str]:
    """Name and title, whose lines stand in one column; a long title ends with an ellipsis."""
    room = max(width - gap, 20)
    lines = textwrap.wrap(
        str(entry["title"]), room, max_lines=most, placeholder=" …", break_on_hyphens=False
    )
    first, *others = lines or [""]
    return [f"{entry['name']:<{gap}}{first}".rstrip(), *(" " * gap + line for line in others)]
