"""Verbs `report` and `table`: from the rows of a run to paper and screen (see run_report.py)."""

from pathlib import Path
from typing import Final

import click

from sysid_bench.commands.request import OK, Request, argument, option, python_function

FORMATS: Final = ("md", "csv", "latex", "json")


class Report(Request[Path]):
    """Write a run's tables, figures and report.html again."""

    has_json = False

    folder: str | Path = argument("RUN", complete="runs folders")

    def run(self) -> Path:
        """Write tables/, figures/ and report.html of a run from its folder alone; return its path.

        Raises UsageError for a folder without rows.
        """
        from sysid_bench.commands.run_report import write_report_of

        return write_report_of(self.folder)

    def shell(self, as_json: bool) -> int:
        click.echo(str(self.run()))
        return OK


class Table(Request[str]):
    """Print one table of a run."""

    has_json = False

    folder: str | Path = argument("RUN", complete="runs folders")
    name: str = argument("NAME", complete="tables")
    form: str | None = option(
        "md, csv, latex or json; default: drawn, piped as md.",
        default=None, flags="--format", complete="formats",
    )  # fmt: skip

    def run(self) -> str:
        """Return one table of a run as Markdown ("md", the default), CSV, LaTeX or JSON; raise
        UsageError for an unknown name."""
        from sysid_bench.commands.run_report import table_text

        return table_text(self.folder, self.name, self.form or "md")

    def shell(self, as_json: bool) -> int:
        from sysid_bench.commands.run_folder import damage_note, open_run
        from sysid_bench.commands.terminal import print_table

        if note := damage_note(open_run(self.folder).damaged):
            click.echo(note, err=True)
        print_table(self.run(), self.form)
        return OK


report = python_function(Report, "report")
table = python_function(Table, "table")
