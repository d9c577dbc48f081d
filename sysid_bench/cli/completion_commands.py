"""Command that makes a shell complete words; what the shell then asks is in `completion`."""

import os
from pathlib import Path

import click

from sysid_bench.cli.options import OK, report_errors
from sysid_bench.completion.start_files import SCRIPTS, START_FILES
from sysid_bench.completion.stored_words import stored_words
from sysid_bench.errors import UsageError, unknown_name


@click.command()
@click.argument("shell", metavar="[bash|zsh|fish]", required=False)
@click.option("--install", is_flag=True, help="Switch it on in every new shell, by its start file.")
@report_errors
def completion(shell: str | None, install: bool) -> int:
    """Print the script that completes verbs, options and names in a shell; default: this shell.

    `sysid-bench completion --install` switches it on.
    """
    name = shell or os.path.basename(os.environ.get("SHELL", ""))
    if name not in SCRIPTS:
        raise unknown_name("shell that completes", name, SCRIPTS)
    stored_words()  # the first answer is as quick as the others
    if install:
        _install(name)
    else:
        click.echo(SCRIPTS[name].strip("\n"))
    return OK


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
