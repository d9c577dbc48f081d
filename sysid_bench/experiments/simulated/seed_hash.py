"""Secret seeds of sealed plants: a plant states the hash of its seed, and runs where that is."""

import hashlib
import os
import re
from functools import cache
from pathlib import Path
from typing import Any, Final

from sysid_bench.errors import UsageError
from sysid_bench.input_files import read_text

SEALED: Final = "sealed"
"""Key of a plant: the SHA-256 of its seed in hexadecimal digits."""
SEEDS: Final = "SYSID_BENCH_SEEDS"
"""Environment variable: a file with secret seeds, a line each."""
_SHORTEST: Final = 32  # characters; a shorter seed could be found from its hash by trying


def check_seed_hash(value: Any) -> None:
    """Raise UsageError for a value that is not a SHA-256 in hexadecimal digits."""
    if not isinstance(value, str) or not re.fullmatch(r"[0-9a-f]{64}", value):
        raise UsageError(
            f"{SEALED} of a plant is the SHA-256 of a secret seed, 64 hexadecimal digits; got "
            f"{value!r}."
        )


def seed_of_hash(seal: str) -> str:
    """Return the seed with this hash from the file that SYSID_BENCH_SEEDS names.

    Raises UsageError where there is no such file or no such seed in it.
    """
    file = os.environ.get(SEEDS)
    if not file:
        raise UsageError(
            f"The plant is sealed ({seal[:12]}...): a maintainer keeps its seed, and runs it with "
            f"{SEEDS} = the file that holds the seed. Leave its cells out with --select."
        )
    seeds = _seeds(file)
    if seal not in seeds:
        raise UsageError(
            f"No seed of {file!r} has the hash {seal[:12]}... of the sealed plant; there are "
            f"{', '.join(f'{known[:12]}...' for known in seeds) or 'none'}."
        )
    return seeds[seal]


@cache
def _seeds(file: str) -> dict[str, str]:
    """Seeds of a file by their hash."""
    try:
        lines = read_text(Path(file)).split()
    except (OSError, UnicodeDecodeError) as error:
        raise UsageError(f"{SEEDS}: {file!r} cannot be read ({error}).") from error
    short = [number for number, line in enumerate(lines, 1) if len(line) < _SHORTEST]
    if short:
        raise UsageError(
            f"{SEEDS}: seed {short[0]} of {file!r} has fewer than {_SHORTEST} characters; make one "
            "with: python -c 'import secrets; print(secrets.token_hex())'."
        )
    return {hashlib.sha256(line.encode()).hexdigest(): line for line in lines}
