"""Law: a table is the same from the columns that it reads as from all."""

from itertools import product
from typing import Any

import numpy as np
import pytest

from sysid_bench.commands.run_folder import holds
from sysid_bench.commands.run_report import table_lines
from sysid_bench.harness.frames import Frames, data_frames
from sysid_bench.reporting.build_table import build_table
from sysid_bench.reporting.writers import to_markdown
from sysid_bench.words import LABELS

VARIED = ("robot", "noise", "plant", "estimator")


def frames_of(varied: tuple[str, ...]) -> Frames:
    """Frames of two cells for each choice of some labels, every other label is that of all."""
    draw = np.random.default_rng(len(varied))
    rows = [
        {
            **dict.fromkeys(LABELS, "same"),
            **dict(zip(varied, words, strict=True)),
            "id": f"{repeat}{'-'.join(words)}",
            "repeat": repeat,
            "status": "ok",
            "torque_error": draw.random(),
            "joints": [{"name": f"j{n}", "relative": draw.random()} for n in range(3)],
        }
        for words in product("ab", repeat=len(varied))
        for repeat in range(2)
    ]
    return data_frames(rows)


@pytest.mark.parametrize("count", range(len(VARIED) + 1))
@pytest.mark.parametrize("columns", [["joint"], ["estimator", "joint"], ["payload", "joint"]])
def test_labels_that_all_cells_share_change_no_table(columns: list[str], count: int) -> None:
    frames = frames_of(VARIED[:count])
    spec: dict[str, Any] = {
        "name": "main",
        "rows": ["robot"],
        "columns": columns,
        "cells": {"metric": "joint_error", "stat": "median", "interval": "iqr"},
        "select": 'noise != "b"',
    }
    lines = table_lines(frames, spec)
    assert lines.columns.size < frames.by_joint.columns.size
    texts = [to_markdown(build_table(cells, spec, holds)) for cells in (lines, frames.by_joint)]
    assert texts[0] == texts[1]
    assert "0." in texts[0]
    assert ("is taken over" in texts[0]) == (count > 2)
