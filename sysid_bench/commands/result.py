"""Base of the results that commands return: frozen records that also read as mappings."""

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from difflib import get_close_matches
from html import escape
from itertools import takewhile
from pathlib import Path
from typing import Any, Final

from sysid_bench.canonical_json import plain
from sysid_bench.errors import NEAR

OMIT_NONE: Final = {"omit None": True}
"""Metadata of a field that is absent from the mapping and the JSON while it is None."""
HIDDEN: Final = {"hidden": True}
"""Metadata of a field that is never in them."""

_CONTAINERS: Final = (Mapping, list, tuple)


@dataclass(frozen=True, eq=False, repr=False)
class Result(Mapping[str, Any]):
    """Result of a command. Its fields, in order, are the keys of the command's JSON.

    `result.gap`, `result["gap"]`, `dict(result)` and `json.dumps(result.to_dict())` all work;
    `print(result.summary())` prints what the command line prints. Two results are equal when
    their mappings are.
    """

    def summary(self) -> str:
        """Text for the terminal, lines separated by newlines."""
        return "\n".join(f"{key:<12} {_inline(value)}" for key, value in self.items())

    def to_dict(self) -> dict[str, Any]:
        """JSON values: arrays are lists, NaN and infinities None."""
        return dict(plain(self._fields()))

    def write_json(self, file: str | Path) -> None:
        """Write `to_dict` into a file."""
        Path(file).write_text(json.dumps(self.to_dict(), indent=2) + "\n", encoding="utf-8")

    def _fields(self) -> dict[str, Any]:
        """Keys and values of the mapping, in the order of the JSON."""
        shown = (f for f in fields(self) if not HIDDEN.items() <= f.metadata.items())
        return {
            f.name: value
            for f in shown
            if (value := getattr(self, f.name)) is not None
            or not OMIT_NONE.items() <= f.metadata.items()
        }

    def _make_plain(self) -> None:
        """Replace the fields by their JSON values; for use in `__post_init__`."""
        for entry in fields(self):
            # The record is frozen; in __post_init__ nobody has seen it yet.
            object.__setattr__(self, entry.name, plain(getattr(self, entry.name)))

    def __getitem__(self, key: str) -> Any:
        values = self._fields()
        if key in values:
            return values[key]
        near = get_close_matches(str(key), list(values), n=1, cutoff=NEAR)
        raise KeyError(f"{key}; did you mean {near[0]!r}?" if near else str(key))

    def __iter__(self) -> Iterator[str]:
        return iter(self._fields())

    def __len__(self) -> int:
        return len(self._fields())

    def __repr__(self) -> str:
        parts = (f"{key}={_inline(value)}" for key, value in self.items())
        return f"{type(self).__name__}({', '.join(parts)})"

    def _repr_html_(self) -> str:
        """Summary and table of the fields, for notebooks."""
        rows = "".join(
            f"<tr><td>{escape(key)}</td><td>{escape(_inline(value))}</td></tr>"
            for key, value in self.items()
        )
        return (
            f"<pre>{escape(self.summary())}</pre>"
            f"<details><summary>{type(self).__name__}</summary><table>{rows}</table></details>"
        )


def file_text(file: str | Path | None) -> str | None:
    """Name of a file as text; None for None."""
    return None if file is None else str(file)


def value_text(value: float | None, absent: str = "-") -> str:
    """Four significant digits; `absent` for None."""
    return absent if value is None else f"{value:.4g}"


def estimate_text(value: float | None, std: float | None, absent: str = "-") -> str:
    """Value and one standard deviation, as far as they are known."""
    return value_text(value, absent) + ("" if value is None or std is None else f" ± {std:.2g}")


def short_names(names: Iterable[str]) -> tuple[dict[str, str], str]:
    """Names without the words that all begin and end with, and what was left out: of
    "panda_joint1", ... " (panda_*)"."""
    words = {name: name.split("_") for name in names}

    def alike(rows: Iterable[Sequence[str]]) -> int:
        columns = zip(*rows, strict=False)
        return sum(1 for _ in takewhile(lambda column: len(set(column)) == 1, columns))

    first = alike(words.values())
    last = alike([own[:first:-1] for own in words.values()])
    short = {name: "_".join(own[first : len(own) - last]) for name, own in words.items()}
    if len(words) < 2 or not (first or last) or not all(short.values()):
        return {name: name for name in words}, ""
    one = next(iter(words.values()))
    return short, f" ({'_'.join([*one[:first], '*', *one[len(one) - last :]])})"


def interval_text(low: float, high: float) -> str:
    """[low, high] in four significant digits; middle and half width where both print alike."""
    ends = f"{low:.4g}", f"{high:.4g}"
    if ends[0] == ends[1]:
        return f"{0.5 * (low + high):.4g} ± {0.5 * (high - low):.1g}"
    return f"[{', '.join(ends)}]"


def _inline(value: Any) -> str:
    """One line: containers of more than three entries, or of containers, by their size."""
    if isinstance(value, _CONTAINERS) and (len(value) > 3 or _nested(value)):
        return f"<{len(value)} {'entry' if len(value) == 1 else 'entries'}>"
    return f"{value:.4g}" if isinstance(value, float) else repr(value)


def _nested(value: Any) -> bool:
    inner = value.values() if isinstance(value, Mapping) else value
    return any(isinstance(entry, _CONTAINERS) for entry in inner)
