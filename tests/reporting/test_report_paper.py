"""Laws of what a paper takes: one power of ten per column, captions, macros, boxes that fit."""

import re
import subprocess
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from sysid_bench.metrics import METRICS
from sysid_bench.reporting.build_table import build_table
from sysid_bench.reporting.figures import DOUBLE, WIDTH, figure
from sysid_bench.reporting.latex import Origin, suite_macro_text, to_latex
from sysid_bench.reporting.signal_figures import StoredTorque, torque_figure
from sysid_bench.reporting.tables import notation
from tests.reporting.test_report_writers import compiled

ORIGIN = Origin("run", "5c3a", "sysid-bench run smoke")
NOISY = {"noise": ["q 1e-4 rad, tau 0.5 %"]}
SIZES = {"single": (WIDTH, 252.0), "double": (DOUBLE, 516.0)}  # inches, points of TeX
NAMES = (
    "UrOls",
    "UrWls",
    "PandaOls",
    "PandaWls",
    "ArmOls",
    "ArmWls",
    "Cond",
    "Rank",
    "Gap",
    "Many",
)


def noisy_tables(cells: pd.DataFrame, spec: Mapping[str, Any]) -> list[Any]:
    several = {key: value for key, value in spec.items() if key != "cells"}
    wide = {**several, "name": "wide", "columns": ["estimator"], "best": "bold"}
    return [
        build_table(cells, {**spec, "columns": ["estimator"], "select": NOISY}),
        build_table(cells, {**wide, "metrics": ["rmse_test", "torque_error"], "select": NOISY}),
    ]


def macro_specs() -> list[dict[str, Any]]:
    chosen = [("ur5", "ols"), ("ur5", "wls"), ("panda", "ols"), ("panda", "wls"),
              ("anymal_c", "ols"), ("anymal_c", "wls")]  # fmt: skip
    errors = [
        {"metric": "torque_error", "stat": "median",
         "select": {"robot": robot, "estimator": estimator, "repeat": [0, 1, 2]}}
        for robot, estimator in chosen
    ]  # fmt: skip
    others = [("condition", "max"), ("rank", "max"), ("gap", "max"), ("torque_error", "count")]
    named = [*errors, *({"metric": m, "stat": stat, "select": {}} for m, stat in others)]
    return [{"name": name, **spec} for name, spec in zip(NAMES, named, strict=True)]


def numbers_of(tex: str) -> list[str]:
    """Numbers of the body of a table, and the ends of its intervals."""
    body = tex.split("\\midrule")[1].split("\\bottomrule")[0]
    numbers = re.sub(r"\\[a-z]+", " ", body)
    return re.findall(r"(?<![\w.-])-?\d+\.\d+(?:e-?\d+)?(?![\w.])", numbers)


@pytest.mark.parametrize("scale", [1.0, 1e-6, 1e-13, 1e7])
def test_a_column_has_one_power_of_ten(
    cells: pd.DataFrame, spec: Mapping[str, Any], scale: float
) -> None:
    scaled = cells.assign(torque_error=cells["torque_error"] * scale)
    wanted = {**spec, "columns": ["estimator"], "select": NOISY, "best": "none"}
    table = build_table(scaled, wanted)
    tex = to_latex(table, ORIGIN)
    numbers = numbers_of(tex)
    assert numbers
    assert not any("e" in number for number in numbers)
    power = re.search(r"units of \\num\{e(-?\d+)\}", tex)
    factor = 10.0 ** int(power[1]) if power else 1.0
    assert bool(power) == (scale != 1.0)
    values = [end for entry in table.entries.values() if entry.value is not None
              for end in (entry.value, entry.low, entry.high) if end is not None]  # fmt: skip
    printed = sorted(factor * float(number) for number in numbers)
    assert printed == pytest.approx(sorted(values), rel=6e-3)


def test_columns_with_powers_of_their_own_name_them(
    cells: pd.DataFrame, spec: Mapping[str, Any]
) -> None:
    tex = to_latex(build_table(cells, spec), ORIGIN)  # noise-free beside noisy columns
    assert len(re.findall(r"\$\[\\num\{e-13\}\]\$", tex)) == 2
    assert not any("e" in number for number in numbers_of(tex))


@pytest.mark.parametrize("span", [1.5, 90.0, 999.0])
@pytest.mark.parametrize("scale", [1e-13, 3e-5, 1e-3, 1.0, 1e5, 1e12])
def test_a_shared_power_keeps_the_digits_of_every_number(span: float, scale: float) -> None:
    values = scale * np.geomspace(1.0, span, 17)
    style = notation(values, 3)
    factor = 1.0 if style.scale is None else 10.0**style.scale
    plain = style.without_scale()
    for value in values:
        assert factor * float(plain.text(value / factor)) == pytest.approx(value, rel=5.1e-3)


def test_numbers_too_far_apart_share_no_power() -> None:
    assert notation([1e-13, 1e-2], 3).scale is None
    assert notation([1e-13, 9e-11], 3).scale == -11


def test_captions_explain_bold_and_repeats(cells: pd.DataFrame, spec: Mapping[str, Any]) -> None:
    marked = to_latex(build_table(cells, spec), ORIGIN)
    assert "3 repeats of each setting." in marked
    assert "Bold:" in marked
    assert "not a test" in marked
    one = build_table(cells[cells["repeat"] == 0], {**spec, "best": "none"})
    plain = to_latex(one, ORIGIN)
    assert "repeats of" not in plain
    assert "Bold" not in plain


def test_a_narrow_table_is_centred(cells: pd.DataFrame, spec: Mapping[str, Any]) -> None:
    """TeX centres lines of text, and no box between paragraphs."""
    tex = to_latex(build_table(cells, spec), ORIGIN)
    uses = re.findall(r"(\\leavevmode|\\resizebox\{\\linewidth\}\{!\}\{)?\\box0", tex)
    assert len(uses) == 3
    assert all(uses)


def test_named_macros_are_the_statistics_of_their_cells(cells: pd.DataFrame) -> None:
    tex = suite_macro_text(cells, macro_specs(), lambda *_: True, METRICS, ORIGIN)
    found = dict(re.findall(r"\\newcommand\{\\([A-Za-z]+)\}\{\\num\{(.+)\}\}", tex))
    assert tuple(found) == NAMES
    ur = cells[(cells["robot"] == "ur5") & (cells["estimator"] == "ols")]
    assert float(found["UrOls"]) == pytest.approx(ur["torque_error"].median(), rel=6e-3)
    assert float(found["Cond"]) == pytest.approx(cells["condition"].max(), rel=6e-3)
    assert int(found["Many"]) == int(cells["torque_error"].notna().sum())


def test_macros_do_not_change_with_the_label_of_a_noise(cells: pd.DataFrame) -> None:
    renamed = cells.assign(noise=cells["noise"].replace({NOISY["noise"][0]: "other"}))
    texts = [
        suite_macro_text(data, macro_specs(), lambda *_: True, METRICS, ORIGIN)
        for data in (cells, renamed)
    ]
    assert texts[0] == texts[1]


def test_a_macro_without_a_number_is_a_dash(cells: pd.DataFrame) -> None:
    lost = cells.assign(status="failed")
    (spec, *_) = macro_specs()
    assert "{\\UrOls}{--}" in suite_macro_text(lost, [spec], lambda *_: True, METRICS, ORIGIN)


def sample(joints: int = 2) -> StoredTorque:
    t = np.arange(500) / 100
    measured = np.sin(t[:, None] + np.arange(joints))
    noise = 0.01 * np.random.default_rng(0).standard_normal(measured.shape)
    rows, units = tuple(f"joint_{i}$" for i in range(joints)), ("N m",) * joints
    return StoredTorque("Held-out motion", t, measured, measured + noise, rows, units)


def axes_of(svg: str) -> int:
    return len(re.findall(r'<g id="axes_\d+">', svg))


def test_noise_free_and_noisy_results_have_axes_of_their_own(
    cells: pd.DataFrame, spec: Mapping[str, Any]
) -> None:
    both = build_table(cells, spec)
    assert axes_of(figure.svg(both)) == 2
    assert axes_of(figure.svg(build_table(cells, {**spec, "select": NOISY}))) == 1
    rows = {**spec, "rows": ["robot", "noise"], "columns": ["estimator"]}
    assert axes_of(figure.svg(build_table(cells, rows))) == 2
    crossed = {"rows": ["robot"], "columns": ["noise"], "cells": {"metric": "torque_error"}}
    assert axes_of(figure.svg(build_table(cells, crossed))) == 2  # not one map with one scale


def test_residuals_have_axes_of_their_own() -> None:
    assert [axes_of(torque_figure.svg(sample(joints))) for joints in (1, 2, 7)] == [2, 4, 14]


@pytest.mark.parametrize("size", SIZES)
def test_figures_fit_their_columns(
    cells: pd.DataFrame, spec: Mapping[str, Any], tmp_path: Path, size: str
) -> None:
    inches, points = SIZES[size]
    long = cells.assign(robot=cells["robot"] + "_description:a_very_long_name/urdf/" * 2)
    for number, made in enumerate((cells, long)):
        path = figure.write(tmp_path / f"{number}.svg", build_table(made, spec), inches)
        assert width_of(path) <= points / 72.27
    assert width_of(torque_figure.write(tmp_path / "t.svg", sample(), inches)) <= points / 72.27


def width_of(svg: Path) -> float:
    """Inches."""
    found = re.search(r'<svg[^>]* width="([\d.]+)pt"', svg.read_text())
    assert found is not None
    return float(found[1]) / 72


@pytest.mark.long
def test_a_two_column_paper_compiles_without_overfull_boxes(
    cells: pd.DataFrame, spec: Mapping[str, Any], tmp_path: Path
) -> None:
    tables = noisy_tables(cells, spec)
    macros = suite_macro_text(cells, macro_specs(), lambda *_: True, METRICS, ORIGIN)
    figure.write(tmp_path / "one.pdf", tables[0])
    torque_figure.write(tmp_path / "two.pdf", sample(), WIDTH)
    torque_figure.write(tmp_path / "three.pdf", sample(), DOUBLE)
    text = " ".join(f"The number is \\{name}{{}} here." for name in NAMES)
    float_ = (
        "\\begin{{figure{0}}}\\centering\\includegraphics{{{1}}}\\caption{{A}}\\end{{figure{0}}}\n"
    )
    figures = [float_.format("", "one"), float_.format("", "two"), float_.format("*", "three")]
    body = "".join([*figures, *(to_latex(table, ORIGIN) for table in tables), text])
    compiled(f"{paper_class()}\n{macros}\\begin{{document}}\n{body}\n\\end{{document}}\n", tmp_path)
    log = (tmp_path / "t.log").read_text(errors="replace")
    assert "Overfull" not in log
    assert log.count("Package siunitx Error") == 0


def paper_class() -> str:
    """The IEEE class where it is installed, else an article with its columns."""
    packages = "\\usepackage[T1]{fontenc}\\usepackage{lmodern,textcomp,booktabs,siunitx,graphicx}\n"
    found = subprocess.run(["kpsewhich", "IEEEtran.cls"], capture_output=True, check=False)
    if found.returncode == 0:
        return f"\\documentclass{{IEEEtran}}\n{packages}"
    columns = "\\setlength{\\textwidth}{516pt}\\setlength{\\columnsep}{12pt}"
    return f"\\documentclass[10pt,twocolumn]{{article}}\n{packages}{columns}\\hoffset=-60pt\n"
