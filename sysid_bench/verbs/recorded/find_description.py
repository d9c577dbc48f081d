"""Recordings of commands: a description that was given, or the file of one."""

from pathlib import Path
from typing import Final

from sysid_bench.errors import UsageError
from sysid_bench.input_files import is_file
from sysid_bench.signals.log_description import LogDescription, read_description

DESCRIPTION: Final = (
    "file = '{}', rate = '200 Hz', joints = ['j1'], q = {{ columns = [1], unit = 'rad' }}, "
    "tau = {{ columns = [2], unit = 'N m' }}, one key a line."
)
"""Smallest description of a recording, with the name of its file left open."""


def find_description(file: Path | LogDescription) -> LogDescription:
    """Return the description of a recording; raises UsageError, with an example for a file that is
    not TOML."""
    if isinstance(file, LogDescription):
        return file
    try:
        return read_description(file)
    except UsageError as error:
        if file.suffix.lower() == ".toml" or not is_file(file):
            raise
        raise UsageError(
            f"{str(file)!r} is not the description of a recording. Let sysid-bench init log "
            f"{file.name} --model MODEL write one, or write a TOML file that names its data and "
            f"its columns, and give that: {DESCRIPTION.format(file.name)}"
        ) from error
