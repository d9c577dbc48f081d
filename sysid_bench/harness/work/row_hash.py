"""Hash of a row at the end of its line, as its last field: a row that was changed after it was
written is found wherever it is read.

It guards against faults of machines and careless editing; whoever wants to can hash a false row.
Lines without a hash are of earlier versions: they are read where a run does not state that its rows
are hashed.
"""

import hashlib
import json
from typing import Final

HASH: Final = "row_sha256"
"""The last field of a line."""

_BEGIN: Final = f', "{HASH}": "'.encode()
_SIZE: Final = len(_BEGIN) + 64 + len(b'"}')


def with_hash(line: bytes) -> bytes:
    """Return the line of a JSON object, which has fields, with its hash."""
    return line[:-1] + _BEGIN + hashlib.sha256(line).hexdigest().encode() + b'"}'


def without_hash(line: bytes) -> bytes:
    """Return the JSON object to which `with_hash` gave its hash; a line without one, or with that
    of other bytes, as it is."""
    text = line.rstrip()
    content = text[:-_SIZE] + b"}"
    return content if text == with_hash(content) else line


def hash_error(line: bytes, *, hashed: bool) -> str | None:
    """Return the id of a row that was changed after it was written, of a run with `hashed` rows
    also of one without a hash; None for any other line."""
    text = without_hash(line)
    try:
        row = json.loads(text)
    except (ValueError, RecursionError):
        return None
    if text != line or not isinstance(row, dict) or not isinstance(row.get("id"), str):
        return None
    return row["id"] if hashed or HASH in row else None
