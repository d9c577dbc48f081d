"""Origin of a frozen suite: its folder, the user's robots, and the command as it was typed."""

import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final

from sysid_bench.harness.suite.model import Origin, Suite

HASHED: Final = "hashed"
"""Statement of a run whose rows all have a hash."""


def with_rows(suite: Suite, *, hashed: bool) -> Suite:
    """The suite with the statement that rows of its run are hashed, or without it."""
    origin = suite.origin or Origin(folder=str(suite.folder))
    rows = HASHED if hashed else None
    return suite.model_copy(update={"origin": origin.model_copy(update={"rows": rows})})


def origin_of(
    suite: Suite,
    source: str,
    robots_dir: Path | None,
    overrides: Mapping[str, str],
    selection: Sequence[str],
) -> Origin:
    """Origin of the suite that `source` named; `selection` are the words that chose cells."""
    words = ["sysid-bench", "run", source]
    words += ["--robots", str(robots_dir)] if robots_dir else []
    words += [word for key, value in overrides.items() for word in ("--set", f"{key}={value}")]
    return Origin(
        folder=str(suite.folder),
        robots=str(robots_dir.resolve()) if robots_dir else None,
        command=shlex.join(words),
        selection=tuple(selection),
    )


def selection_words(select: str | None, limit: int | None, shard: object) -> tuple[str, ...]:
    """Words of the command line that choose some of the cells."""
    given = {"--select": select, "--limit": limit, "--shard": shard}
    pairs = [(word, str(value)) for word, value in given.items() if value is not None]
    return tuple(part for pair in pairs for part in pair)
