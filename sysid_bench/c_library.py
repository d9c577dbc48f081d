"""Compiled helpers of the package: a library is used only if it was compiled from today's text."""

import ctypes
import hashlib
from pathlib import Path
from typing import Any


def c_library(source: Path, library: str, hash_function: str) -> Any:
    """The library (ctypes) that was compiled from a C file, which lies beside it.

    Raises OSError, with the reason, where none was compiled or one from another text.
    """
    files = [source.with_name(f"{library}{suffix}") for suffix in (".so", ".dylib", ".dll")]
    file = next((file for file in files if file.is_file()), None)
    if file is None:
        raise OSError(
            f"no {library} was compiled when the package was installed; with a C compiler, gcc or "
            "clang, installing it again compiles one"
        )
    dll = ctypes.CDLL(str(file))
    told = getattr(dll, hash_function)
    told.restype = ctypes.c_char_p
    if told().decode() != hashlib.sha256(source.read_bytes()).hexdigest():
        raise OSError(
            f"{file.name} was compiled from another {source.name}; install the package again"
        )
    return dll
