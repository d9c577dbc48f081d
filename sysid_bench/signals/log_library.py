"""Libraries of log readers that come with the extra `logs`, imported when a file needs them."""

from importlib import import_module
from pathlib import Path
from typing import Any

from sysid_bench.errors import UsageError


def log_library(module: str, path: Path) -> Any:
    """Return a module of the extra `logs`; raises UsageError with the command that installs it."""
    try:
        return import_module(module)
    except ImportError as error:
        library = module.partition(".")[0]
        raise UsageError(
            f"{path} needs the library {library}, which is not installed: "
            "pip install 'sysid-bench[logs]'."
        ) from error
