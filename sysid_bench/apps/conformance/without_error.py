"""A model or sensor error whose sizes are zero."""

from dataclasses import is_dataclass, replace
from typing import Any

from sysid_bench.errors import UsageError


def without_error(error: Any) -> Any:
    """Return the error with the settings that its `sizes` names at zero.

    Raises UsageError for a plug-in that is not a dataclass or declares no sizes.
    """
    sizes = getattr(error, "sizes", ())
    if not sizes or not is_dataclass(error) or isinstance(error, type):
        raise UsageError(
            "A model or sensor error is a dataclass with the class attribute "
            "`sizes = ('position', ...)`: names of the settings that are zero without it."
        )
    return replace(error, **dict.fromkeys(sizes, 0.0))
