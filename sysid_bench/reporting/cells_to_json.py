"""All cells of a run as compact JSON data, which the page draws, filters and sorts."""

import math
from collections.abc import Iterable, Mapping
from functools import partial
from typing import TYPE_CHECKING, Any, Final
from urllib.parse import quote

from sysid_bench.metrics import METRICS
from sysid_bench.reporting.selection import label
from sysid_bench.types import Metric

if TYPE_CHECKING:
    import pandas as pd

_WORDS: Final = (
    "robot", "payload", "task", "plant", "excitation", "simulation", "noise", "repeat",
    "estimator", "status",
)  # fmt: skip
_LONGEST: Final = 160
_LARGEST_WHOLE: Final = 1e9


def cells_to_json(
    cells: "pd.DataFrame",
    recordings: Mapping[str, str],
    metrics: Mapping[str, Metric] = METRICS,
) -> dict[str, Any]:
    """All cells as compact JSON data: words as numbers of a dictionary, four digits of a metric.

    `metrics` by name; those that are `shown` become columns.
    """
    words = _words(cells)
    # A word is stored once: thousands of cells repeat few robots, payloads and estimators.
    dictionary = [list(dict.fromkeys(texts)) for texts in words.values()]
    scores = _scores(cells, metrics)
    ids = list(map(str, cells["id"]))
    # The script of the page reads the columns in this order.
    columns = [
        ids,
        *map(_codes, words.values(), dictionary),
        *(map(partial(_four_digits, metric.scale), cells[metric.name]) for metric in scores),
        _links(ids, recordings),
    ]
    return {
        "words": list(words),
        "dictionary": dictionary,
        "scores": [metric.name for metric in scores],
        "titles": [metric.heading for metric in scores],
        "rows": list(map(list, zip(*columns, strict=True))),
    }


def _words(cells: "pd.DataFrame") -> dict[str, list[str]]:
    """Text columns by name, the reason last."""
    words = {name: list(map(label, cells[name])) for name in _WORDS if name in cells.columns}
    return {
        **words,
        "reason": [_reason(value) for value in cells.get("reason", [None] * len(cells))],
    }


def _reason(value: Any) -> str:
    """A reason, cut where it is long: the failures above give it in full."""
    text = label(value)
    if text == "none":
        return ""
    return text if len(text) <= _LONGEST else text[: _LONGEST - 1] + "…"


def _codes(texts: Iterable[str], dictionary: list[str]) -> list[int]:
    """Index of each text in the dictionary."""
    index = {text: i for i, text in enumerate(dictionary)}
    return [index[text] for text in texts]


def _scores(cells: "pd.DataFrame", metrics: Mapping[str, Metric]) -> list[Metric]:
    known = [metrics[name] for name in metrics if metrics[name].name in cells.columns]
    return [metric for metric in known if metric.shown]


def _links(ids: Iterable[str], recordings: Mapping[str, str]) -> list[str | int]:
    """Address of each cell's recording, 0 where it has none."""
    return [quote(recordings[cell]) if cell in recordings else 0 for cell in ids]


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
