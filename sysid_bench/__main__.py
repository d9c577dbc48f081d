"""`python -m sysid_bench` and the command `sysid-bench`."""

from sysid_bench.commands.main import main


def start() -> None:
    """Run the command line."""
    main(prog_name="sysid-bench")


if __name__ == "__main__":
    start()
