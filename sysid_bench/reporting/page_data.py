"""Compressed data of a page, read when needed: all cells, joints of a few cells, torques."""

import base64
import gzip
import json
import math
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sysid_bench.reporting.torque_figure import StoredTorque
from sysid_bench.types import Array

if TYPE_CHECKING:
    import pandas as pd

JOINT_SCORES: Final = ("id", "name", "relative", "rmse_test")
"""Columns of the joints that an open row shows."""

CELLS: Final = 500
"""Cells of a chunk of joints: reading one takes a few milliseconds."""

MOST_JOINTS: Final = 4_500_000
"""Bytes of all chunks of joints; a page of 50,000 cells stays below 8 MB."""

_SAMPLES: Final = 400  # of a curve: as many as a figure has points across


def data_text(data: Any) -> str:
    """JSON data as base64 of gzip, which can end no element of a page; the same text every time."""
    text = json.dumps(data, ensure_ascii=False, allow_nan=False, separators=(",", ":"))
    return _packed_text(text)


def joint_blocks(cells: "pd.DataFrame", joints: "pd.DataFrame") -> tuple[str, ...]:
    """Scores per joint of `CELLS` cells each, in the order of the cells, packed; the last chunks
    are left out where all of them are larger than `MOST_JOINTS`.

    A chunk has `names` (lists of joints), `which` of them each cell has (-1: none), and the
    numbers of one cell after another.
    """
    joints = joints if "id" in joints else joints.rename(columns={"cell": "id"})
    if joints.empty or not set(JOINT_SCORES[:3]) <= set(joints.columns):
        return ()
    chunks, size = list[str](), 0
    for chunk in _joint_texts(cells, joints):
        chunks.append(_packed_text(chunk))
        size += len(chunks[-1])
        if size > MOST_JOINTS:
            return tuple(chunks[:-1])
    return tuple(chunks)


def _joint_texts(cells: "pd.DataFrame", joints: "pd.DataFrame") -> Iterator[str]:
    """JSON of each chunk."""
    import pandas as pd

    places = pd.Series(np.arange(len(cells)), index=cells["id"].astype(str))
    known = joints["id"].map(places)
    kept = joints.assign(place=known)[known.notna()].sort_values("place", kind="stable")
    place = kept["place"].to_numpy(int)
    for first in range(0, len(cells), CELLS):
        start, stop = np.searchsorted(place, [first, first + CELLS])
        counts = np.bincount(place[start:stop] - first, minlength=min(CELLS, len(cells) - first))
        yield _joint_text(kept.iloc[start:stop], counts)


def _joint_text(joints: "pd.DataFrame", counts: np.ndarray) -> str:
    """JSON of the joints of a few cells, `counts` of them for each."""
    names, ends = joints["name"].astype(str).tolist(), np.cumsum(counts)
    lists: dict[tuple[str, ...], int] = {(): -1}
    which = [
        lists.setdefault(tuple(names[end - count : end]), len(lists) - 1)
        for end, count in zip(ends.tolist(), counts.tolist(), strict=True)
    ]
    head = json.dumps({"names": list(lists)[1:], "which": which}, separators=(",", ":"))
    columns = (f'"{name}":[{_numbers(joints, name)}]' for name in JOINT_SCORES[2:])
    return f"{head[:-1]},{','.join(columns)}}}"


def _numbers(joints: "pd.DataFrame", name: str) -> str:
    """Three digits of each number; null where there is none."""
    # A column without any number holds None, which no format takes.
    given = joints[name].astype(float).tolist() if name in joints else [math.nan] * len(joints)
    return ",".join("null" if text[-1] in "nf" else text for text in map("%.3g".__mod__, given))


def torque_data(sample: StoredTorque) -> str:
    """Curves of a row that opens, packed: every n-th sample, four digits."""
    step = max(1, -(-len(sample.t) // _SAMPLES))
    return data_text(
        {
            "title": sample.title,
            "step": step,
            "rows": sample.rows,
            "units": sample.units,
            "t": _rounded(sample.t[::step]),
            "measured": [_rounded(curve) for curve in sample.measured[::step].T],
            "predicted": [_rounded(curve) for curve in sample.predicted[::step].T],
        }
    )


def _rounded(values: Array) -> list[float | None]:
    return [float(f"{v:.4g}") if np.isfinite(v) else None for v in values.tolist()]


def read_data_text(text: str) -> Mapping[str, Any]:
    """The JSON data of a packed text."""
    return dict(json.loads(gzip.decompress(base64.b64decode(text))))


def _packed_text(text: str) -> str:
    return base64.b64encode(gzip.compress(text.encode(), 6, mtime=0)).decode()
