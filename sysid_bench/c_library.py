"""Loading of the package's compiled libraries: a stale one, of another source text, is refused."""

import ctypes
import hashlib
from pathlib import Path
from typing import Any


def c_library(source: Path, library: str, hash_function: str) -> Any:
    """Return the library (ctypes) that was compiled from the C file `source` in the same folder.

    `hash_function` names its function that returns the SHA-256 of the source text. Raises OSError,
    with the reason, if there is no library, or one compiled from another text.
    """
    file = _compiled_file(source, library)
    dll = ctypes.CDLL(str(file))
    source_hash = getattr(dll, hash_function)
    source_hash.restype = ctypes.c_char_p  # ctypes takes results for ints, which cut pointers off
    if source_hash().decode() != hashlib.sha256(source.read_bytes()).hexdigest():
        raise OSError(
            f"{file.name} was compiled from another {source.name}; install the package again"
        )
    return dll


def _compiled_file(source: Path, library: str) -> Path:
    """File of the library beside its source; the suffix depends on the operating system."""
    for suffix in (".so", ".dylib", ".dll"):
        file = source.with_name(f"{library}{suffix}")
        if file.is_file():
            return file
    raise OSError(
        f"{library} was not compiled when the package was installed; to compile it, install a "
        "C compiler, gcc or clang, and then the package again"
    )
