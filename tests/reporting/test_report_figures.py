"""Laws of figures: the same bytes every time, any name, no entry left out."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pandas as pd
import pytest

from sysid_bench.errors import UsageError
from sysid_bench.reporting.build_table import build_table
from sysid_bench.reporting.figures import WIDTH, figure

MAP = {"rows": ["robot"], "columns": ["payload"], "cells": {"metric": "gap", "stat": "max"}}


@pytest.mark.parametrize("suffix", [".pdf", ".png", ".svg"])
@pytest.mark.parametrize("shape", ["dots", "map"])
def test_a_figure_is_the_same_bytes_every_time(
    cells: pd.DataFrame, spec: Mapping[str, Any], tmp_path: Path, suffix: str, shape: str
) -> None:
    table = build_table(cells, spec if shape == "dots" else MAP)
    one, two = (figure.write(tmp_path / f"{i}{suffix}", table).read_bytes() for i in range(2))
    assert one == two
    assert len(one) > 2000


def test_a_figure_fits_one_column_of_a_paper(cells: pd.DataFrame, spec: Mapping[str, Any]) -> None:
    for wanted in (spec, MAP):
        root = ElementTree.fromstring(figure.svg(build_table(cells, wanted)))
        assert float(root.attrib["width"].removesuffix("pt")) <= 72 * (WIDTH + 0.1)


@pytest.mark.parametrize("shape", ["dots", "map"])
def test_failures_stand_in_the_figure(
    cells: pd.DataFrame, spec: Mapping[str, Any], shape: str
) -> None:
    # Glyphs are paths; the writer keeps each text as a comment beside them.
    svg = figure.svg(build_table(cells, spec if shape == "dots" else MAP))
    assert "<!-- failed -->" in svg


def test_any_name_can_be_drawn(cells: pd.DataFrame, spec: Mapping[str, Any]) -> None:
    long = "robot_descriptions:a_very_long_name_description/urdf/" * 3
    names = {"ur5": "$x_" + long, "panda": "机器人 \U0001f916 \n", "anymal_c": "<script>--&"}
    renamed = cells.assign(robot=cells["robot"].map(names))
    for wanted in (spec, MAP):
        ElementTree.fromstring(figure.svg(build_table(renamed, wanted)))


@pytest.mark.parametrize("value", [0.0, -1.0, 1e-300, np.nan])
def test_odd_values_can_be_drawn(
    cells: pd.DataFrame, spec: Mapping[str, Any], value: float
) -> None:
    odd = cells.assign(torque_error=value, gap=value)
    for wanted in (spec, MAP):
        ElementTree.fromstring(figure.svg(build_table(odd, wanted)))


def test_another_suffix_is_refused(cells: pd.DataFrame, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"\.pdf, \.png or \.svg"):
        figure.write(tmp_path / "f.jpg", build_table(cells, MAP))
    assert not list(tmp_path.iterdir())
