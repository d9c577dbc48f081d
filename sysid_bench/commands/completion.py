"""Verb `completion`: what makes a shell complete words; its questions are answered by click."""

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Final

import click
from click.shell_completion import get_completion_class

from sysid_bench.commands.completion_values import names_of
from sysid_bench.commands.request import OK, Request, argument, option
from sysid_bench.errors import UsageError, unknown_name

VARIABLE: Final = "_SYSID_BENCH_COMPLETE"
"""Variable in which a script asks, as click reads it."""
START_FILES: Final[Mapping[str, str]] = {
    "bash": "~/.bashrc",
    "zsh": "~/.zshrc",
    "fish": "~/.config/fish/config.fish",
}
"""File that each shell reads when it starts."""


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
        if self.install:
            _install(name)
        else:
            click.echo(script(name).strip("\n"))
        return OK


def script(shell: str) -> str:
    """Return the script of a shell."""
    from sysid_bench.commands.main import main

    found = get_completion_class(shell)
    assert found is not None
    return found(main, {}, "sysid-bench", VARIABLE).source()


def _install(shell: str) -> None:
    """Add a line to the start file of a shell, once."""
    file = Path(START_FILES[shell]).expanduser()
    line = f'eval "$(sysid-bench completion {shell})"'
    if shell == "fish":
        line = "sysid-bench completion fish | source"
    text = file.read_text(encoding="utf-8") if file.exists() else ""
    if line in text.splitlines():
        raise UsageError(f"{file} has the line already: {line}.")
    file.parent.mkdir(parents=True, exist_ok=True)
    with file.open("a", encoding="utf-8") as start:
        start.write(("" if text.endswith("\n") or not text else "\n") + line + "\n")
    click.echo(f"{file} has the line: {line}\nOpen a new shell, or run that line in this one.")
