"""Compiled libraries that hold their functions once per instruction set; the processor chooses."""

import os
from pathlib import Path
from typing import Any, Final

from sysid_bench.errors import UsageError
from sysid_bench.package_folders import c_library

VARIABLE: Final = "SYSID_BENCH_KERNEL"
"""Environment variable that selects the kernels: `numpy`, `compiled` or one of `LEVELS`; unset, the
fastest are used."""

LEVELS: Final = {"x86-64-v4": "v4", "x86-64-v3": "v3", "baseline": "base"}
"""Instruction sets, fastest first, with the suffix of the functions compiled for them: AVX-512,
AVX2 with FMA, and the baseline of the architecture."""


def usable_levels(dll: Any) -> list[str]:
    """Return the instruction sets that the library and this processor have, fastest first."""
    return [
        name
        for name, suffix in LEVELS.items()
        if hasattr(dll, f"work_{suffix}") and dll.kernel_runs(suffix.encode())
    ]


def levelled_library(source: Path, library: str, hash_function: str) -> tuple[Any, str]:
    """Return the library (ctypes) compiled from `source`, and the instruction set to use: that
    which the environment variable names, or the fastest of this processor.

    Raises OSError, with the reason, where there is none or the variable selects none, UsageError
    for an invalid value of the variable.
    """
    wanted = os.environ.get(VARIABLE, "")
    if wanted not in ("", "numpy", "compiled", *LEVELS):
        known = ", ".join(("numpy", "compiled", *LEVELS))
        raise UsageError(f"{VARIABLE} is {wanted!r}; unset it, or use one of {known}.")
    if wanted == "numpy":
        raise OSError(f"selected by {VARIABLE}")
    dll = c_library(source, library, hash_function)
    usable = usable_levels(dll)
    if wanted in LEVELS and wanted not in usable:
        raise OSError(f"{wanted} is not supported by this machine; it has {', '.join(usable)}")
    return dll, wanted if wanted in LEVELS else usable[0]
