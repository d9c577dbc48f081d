"""Page of the verbs of the command line with their options, from its parser."""

from collections.abc import Iterator, Mapping
from typing import Final

import click

from sysid_bench.reference.page_text import code, markdown_line, markdown_text, page, table

_HARMLESS: Final = ("ok", "unsupported", "skipped")
PROGRAM: Final = "sysid-bench"
EXIT_CODES: Final[Mapping[int, str]] = {
    0: "ok",
    1: "a cross-check, a gate or a check failed, a recording contradicts its model, or merged "
    "results contradict each other",
    2: "wrong usage, suite or model, or rows cannot be stored",
    3: f"a cell has another status than {', '.join(_HARMLESS)}, or an identified robot errs more "
    "than zero torque on its test (torque error above 1)",
    4: "nothing was selected or measured",
    5: "scheduler or workers of the executor are gone; the same command resumes the run",
    130: "interrupted; a run is resumed by the same command",
}
"""Meaning of the exit codes of all verbs."""


def commands_page(group: click.Group) -> str:
    """Return each verb with its usage, description and options."""
    parts = (_section(name, command) for name, command in commands(group))
    return page("# Verbs and options", _exit_codes(), *parts)


def _exit_codes() -> str:
    """Return the exit codes as a section."""
    rows = ((str(number), markdown_line(text)) for number, text in EXIT_CODES.items())
    return page("## Exit codes", table(("code", "meaning"), rows)).strip()


def commands(group: click.Group, prefix: str = "") -> Iterator[tuple[str, click.Command]]:
    """Yield (name, command) of each verb, those of a group as "baseline save"."""
    context = click.Context(group)
    for name in group.list_commands(context):
        command = group.get_command(context, name)
        assert command is not None
        yield prefix + name, command
        if isinstance(command, click.Group):
            yield from commands(command, f"{prefix}{name} ")


def _section(name: str, command: click.Command) -> str:
    context = click.Context(command, info_name=f"{PROGRAM} {name}")
    usage = " ".join([f"{PROGRAM} {name}", *command.collect_usage_pieces(context)])
    records = filter(None, (param.get_help_record(context) for param in command.params))
    rows = [(code(name), markdown_line(text)) for name, text in records]
    return page(
        f"## `{name}`",
        f"```\n{usage}\n```",
        markdown_text(command.help or ""),
        table(("argument or option", "meaning"), rows) if rows else "",
    ).strip()
