"""Errors of libraries that read recorded files, as one sentence: they raise many types."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from sysid_bench.errors import UsageError, reason_of


@contextmanager
def library_errors(path: Path, kind: str) -> Iterator[None]:
    """Turn what a library raises on a damaged file of a `kind` ("an HDF5 file") into UsageError."""
    try:
        yield
    except UsageError:
        raise
    except MemoryError as error:
        raise UsageError(
            f"{path} states more data than memory holds: it is damaged or too large; write it "
            "again, or in parts."
        ) from error
    except Exception as error:
        raise UsageError(f"{path} is not {kind} that can be read: {reason_of(error)}.") from error
