"""Runs a suite of trivial tasks: what tests kill. Arguments: suite file, run folder."""

import sys
from pathlib import Path

from harness_world import NAMES

from sysid_bench.verbs.runs.run import run

result = run(
    sys.argv[1], Path(sys.argv[2]), jobs=2, names=NAMES, call="harness_tasks:execute",
    on_event=lambda kind, data: print(kind, flush=True),
)  # fmt: skip
sys.exit(result.exit_code)
