"""`python -m sysid_bench` and the command `sysid-bench`."""

import sys
from importlib import import_module

_COMPLETE = "complete"


def start() -> None:
    """Run the command line; a shell that asks for completions waits for no command to be loaded."""
    if sys.argv[1:2] == [_COMPLETE] and len(sys.argv) == 4:
        import_module("sysid_bench.completion.answer").answer(*sys.argv[2:])
    else:
        import_module("sysid_bench.cli").main(prog_name="sysid-bench")


if __name__ == "__main__":
    start()
