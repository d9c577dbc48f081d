"""All cells of a run as columns of compact JSON data, which the page draws, filters and sorts."""

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Final
from urllib.parse import quote

from sysid_bench.metrics import METRICS
from sysid_bench.reporting.selection import label
from sysid_bench.types import Metric
from sysid_bench.words import LABELS

if TYPE_CHECKING:
    import pandas as pd

_SHOWN: Final = (
    "robot", "payload", "task", "plant", "excitation", "simulation", "noise", "repeat",
    "estimator",
)  # fmt: skip
"""Words that are columns of the table at first, where cells differ by them."""

_WORDS: Final = tuple(dict.fromkeys((*_SHOWN, *LABELS, "stop", "status")))
_LONGEST: Final = 2000
_LARGEST_WHOLE: Final = 1e9


def cells_to_json(
    cells: "pd.DataFrame",
    recordings: Mapping[str, str],
    metrics: Mapping[str, Metric] = METRICS,
) -> dict[str, Any]:
    """All cells as columns of JSON data: words as numbers of a dictionary, four digits of a metric.

    `metrics` by name; those that are `shown` become columns. `links` has the place of each cell
    with a recording. Codes of a dictionary of one word are absent; `count` is that of all cells.
    """
    words = _words(cells)
    # A word is stored once: thousands of cells repeat few robots, payloads and estimators.
    dictionary = [list(dict.fromkeys(texts)) for texts in words.values()]
    scores = _scores(cells, metrics)
    ids = list(map(str, cells["id"]))
    return {
        "ids": ids,
        "words": list(words),
        "dictionary": dictionary,
        "codes": list(map(_codes, words.values(), dictionary)),
        "shown": list(map(_is_shown, words, dictionary)),
        "scores": [metric.name for metric in scores],
        "titles": [metric.heading for metric in scores],
        "values": [_values(cells, metric) for metric in scores],
        "links": {i: quote(recordings[cell]) for i, cell in enumerate(ids) if cell in recordings},
        "hasLinks": not set(recordings).isdisjoint(ids),
        "count": len(ids),
    }


def first_cells(data: Mapping[str, Any], most: int) -> dict[str, Any]:
    """The same columns with at most so many cells, and with the words of these alone."""
    few = [
        _used(words, codes[:most])
        for words, codes in zip(data["dictionary"], data["codes"], strict=True)
    ]
    return {
        **data,
        "ids": data["ids"][:most],
        "dictionary": [words for words, _ in few],
        "codes": [codes for _, codes in few],
        "values": [values[:most] for values in data["values"]],
        "links": {i: place for i, place in data["links"].items() if i < most},
    }


def _used(words: Sequence[str], codes: Sequence[int]) -> tuple[list[str], list[int]]:
    """The words that some codes name, and the codes of these words."""
    used = sorted(set(codes or range(len(words))))
    place = {code: i for i, code in enumerate(used)}
    return [words[code] for code in used], [place[code] for code in codes]


def _words(cells: "pd.DataFrame") -> dict[str, list[str]]:
    """Text columns by name, the reason last."""
    words = {name: list(map(label, cells[name])) for name in _WORDS if name in cells.columns}
    return {
        **words,
        "reason": [_reason(value) for value in cells.get("reason", [None] * len(cells))],
    }


def _is_shown(name: str, words: list[str]) -> bool:
    return name in ("status", "reason") or (name in _SHOWN and len(words) > 1)


def _reason(value: Any) -> str:
    """A reason, cut where it is beyond reading: the row of the cell has it in full."""
    text = label(value)
    if text == "none":
        return ""
    return text if len(text) <= _LONGEST else text[: _LONGEST - 1] + "…"


def _codes(texts: Iterable[str], dictionary: list[str]) -> list[int]:
    """Index of each text in the dictionary; empty where there is one text alone."""
    index = {text: i for i, text in enumerate(dictionary)}
    return [index[text] for text in texts] if len(index) > 1 else []


def _scores(cells: "pd.DataFrame", metrics: Mapping[str, Metric]) -> list[Metric]:
    known = [metrics[name] for name in metrics if metrics[name].name in cells.columns]
    return [metric for metric in known if metric.shown]


def _values(cells: "pd.DataFrame", metric: Metric) -> list[float | int | None]:
    return [_four_digits(metric.scale, value) for value in cells[metric.name]]


def _four_digits(scale: float, value: Any) -> float | int | None:
    """A score times `scale` as a JSON number of four digits; None where it is not finite."""
    try:
        number = float(f"{scale * float(value):.4g}")
    except (TypeError, ValueError):
        return None
    return _shortest(number) if math.isfinite(number) else None


def _shortest(number: float) -> float | int:
    """A whole number without its point, as long as that is shorter."""
    return int(number) if number.is_integer() and abs(number) < _LARGEST_WHOLE else number
