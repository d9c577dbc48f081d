"""`python -m sysid_bench` is the command `sysid-bench`."""

from sysid_bench.cli import main

main(prog_name="sysid-bench")
