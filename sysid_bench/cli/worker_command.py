"""Execution of one command line in a worker process."""

import io
from collections.abc import Mapping
from contextlib import redirect_stdout
from typing import Any

from sysid_bench.cli import main
from sysid_bench.cli.supervise import IN_WORKER
from sysid_bench.experiments.job_channel import JobChannel


def execute(arguments: list[str], channel: JobChannel) -> Mapping[str, Any]:
    """Execute a command line in this process; return its output and its exit code."""
    IN_WORKER.set(True)
    output = io.StringIO()
    with redirect_stdout(output):
        code = main.main(arguments, prog_name="sysid-bench", standalone_mode=False)
    return {"output": output.getvalue(), "code": code or 0}
