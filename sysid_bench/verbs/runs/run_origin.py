"""Origin of the numbers of a run: its name, its cells, the command that makes it."""

import shlex
from typing import TYPE_CHECKING

from sysid_bench.canonical_json import canonical_hash
from sysid_bench.reporting.latex import Origin

if TYPE_CHECKING:
    from sysid_bench.harness.stored_run import RunFolder
    from sysid_bench.harness.suite.model import Suite


def run_origin(run_folder: "RunFolder", rows: int) -> Origin:
    """Origin of the tables of a run with so many rows."""
    cells = sorted(run_folder.planned)
    command = _command(run_folder.suite, whole=rows == len(cells))
    return Origin(run_folder.path.name, canonical_hash(cells)[:12], command)


def _command(suite: "Suite", *, whole: bool) -> str:
    """Command that makes the run: of the suite's [origin], or with its name; with the selection of
    cells unless the run is `whole`."""
    made = suite.origin
    typed = (made.command if made else None) or f"sysid-bench run {shlex.quote(suite.name)}"
    return typed if whole or not made else " ".join([typed, *map(shlex.quote, made.selection)])
