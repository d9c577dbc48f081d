"""Names of pages from names of users."""

import hashlib
import re
from typing import Final

_LONGEST: Final = 60


def page_name(text: str) -> str:
    """Lower-case letters, digits, dashes and underscores, with 6 hex digits of the text where
    that is another text: two names have two pages on any disk."""
    plain = re.sub(r"[^a-z0-9_-]+", "-", text.lower()).strip("-")[:_LONGEST]
    if plain == text:
        return plain
    return f"{plain or 'page'}-{hashlib.sha256(text.encode()).hexdigest()[:6]}"
