"""Options of workers elsewhere, of the address of a scheduler and of a profile alike."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final, Self

from sysid_bench.errors import UsageError, unknown_name
from sysid_bench.units import quantity

NAMES: Final = ("shared", "other-code", "patience")


@dataclass(frozen=True)
class WorkerOptions:
    """`shared`: workers see the same files, so that nothing is sent; `other_code`: workers with
    other versions compute too; `patience` (s): time without any worker that ends the run."""

    shared: bool
    other_code: bool
    patience: float

    @classmethod
    def read(cls, given: Mapping[str, Any], patience: str) -> Self:
        """Return the options of a mapping, in which a flag is True, or "" as in "?shared".

        Raises UsageError for another name or value.
        """
        for name in given:
            if name not in NAMES:
                raise unknown_name("option of workers", name, NAMES)
        flags = {name: _flag(name, given.get(name, False)) for name in NAMES[:2]}
        seconds = quantity(given.get("patience", patience), "s")
        if not seconds > 0:
            raise UsageError(f"patience is {given['patience']!r}; give a positive time, as '60 s'.")
        return cls(flags["shared"], flags["other-code"], seconds)


def _flag(name: str, value: Any) -> bool:
    if value == "" or isinstance(value, bool):
        return bool(value == "" or value)
    raise UsageError(
        f"{name} is {value!r}; it is a flag: '?{name}' in an address, {name} = true in a file."
    )
