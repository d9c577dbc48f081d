"""Laws of the written tables: any name survives, every number comes back, LaTeX compiles."""

import csv
import io
import os
import re
import shutil
import subprocess
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any

import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sysid_bench.reporting.build_table import build_table
from sysid_bench.reporting.latex import Origin, latex_text, macro_names, macro_text, to_latex
from sysid_bench.reporting.tables import Table
from sysid_bench.reporting.writers import markdown_text as escape_markdown
from sysid_bench.reporting.writers import to_csv, to_markdown

ORIGIN = Origin("reports/smoke", "5c3a", "sysid-bench table reports/smoke main --format latex")
# What breaks LaTeX, Markdown or both: specials, a dash, a star after a line end, other scripts.
HOSTILE = (
    r"a_b^c~d\e{f}$g$&h#i%j", "[0.5em] x", "* star", "|pipe|", "--long---dash", "?`!`<<>>,,''",
    "Jürgen Müller", "机器人 \U0001f916", "µ β ± 3·10 °", '"quoted"', "\\input{x}", "a\nb\tc",
    "__init__", "<script>alert(1)</script>", "ÐðÞþß æø", "ﬁ ½ ²",
)  # fmt: skip


def standalone(tex: str) -> str:
    """The smallest document that prints a table or macros."""
    return (
        "\\documentclass{article}\n\\usepackage[T1]{fontenc}\n\\usepackage{lmodern}\n"
        "\\usepackage{textcomp}\n\\usepackage{booktabs}\n\\usepackage{siunitx}\n"
        "\\pagestyle{empty}\n"
        f"\\begin{{document}}\n{tex}\\mbox{{}}\n\\end{{document}}\n"
    )


@pytest.fixture(scope="session")
def table(cells: pd.DataFrame, spec: Mapping[str, Any]) -> Table:
    return build_table(cells, spec)


@pytest.fixture(scope="session")
def hostile(cells: pd.DataFrame, spec: Mapping[str, Any]) -> Table:
    rows = [
        {"robot": name, "payload": name, "noise": name[:9], "estimator": "e_1", "status": status,
         "torque_error": value}
        for name in HOSTILE
        for status, value in (("ok", 0.02), ("ok", 3e-13), ("time_out", None))
    ]  # fmt: skip
    title = "A & B_" + HOSTILE[0]
    return build_table(pd.DataFrame(rows), {**spec, "name": "x_1%", "title": title})


def test_markdown_has_a_line_per_row_and_a_cell_per_column(table: Table, hostile: Table) -> None:
    for made in (table, hostile):
        lines = [line for line in to_markdown(made).splitlines() if line.startswith("|")]
        assert len(lines) == 2 + len(made.rows)
        width = len(made.row_fields) + len(made.columns)
        assert {len(re.findall(r"(?<!\\)\|", line)) - 1 for line in lines} == {width}


@given(st.text())
def test_markdown_prints_any_text_as_it_is(text: str) -> None:
    escaped = escape_markdown(text)
    assert re.sub(r"\\(.)", r"\1", escaped) == " ".join(text.split())
    assert not re.search(r"(?<!\\)(?:\\\\)*[|<>*`\[\]&]", escaped)


def test_csv_gives_every_number_back(table: Table) -> None:
    rows = list(csv.DictReader(io.StringIO(to_csv(table))))
    assert len(rows) == len(table.entries)
    for row in rows:
        entry = table.entries[(row["robot"], row["payload"]), (row["noise"], row["estimator"])]
        for name in ("value", "low", "high"):
            number = getattr(entry, name)
            assert row[name] == "" if number is None else float(row[name]) == number
        assert (int(row["n"]), int(row["n_failed"])) == (entry.n, entry.n_failed)
        assert sum(int(part.split("=")[1]) for part in row["failures"].split()) == entry.n_failed


def test_every_format_names_every_failure(table: Table) -> None:
    for text in (to_markdown(table), to_latex(table, ORIGIN), to_csv(table)):
        for kind in ("failed", "unsupported", "timeout", "crash"):
            assert kind in text


def test_every_format_prints_exact_beside_noisy(cells: pd.DataFrame) -> None:
    wanted = {"metric": "torque_error"}
    table = build_table(cells, {"rows": ["noise"], "columns": ["estimator"], "cells": wanted})
    for text in (to_markdown(table), to_latex(table, ORIGIN)):
        assert len(re.findall(r"\d\.\d\de-13\b", text)) == 2
        assert len(re.findall(r"\d\.\d\de-2\b", text)) == 2


@given(st.text())
def test_latex_leaves_no_special_unescaped(text: str) -> None:
    escaped = latex_text(text)
    bare = re.sub(r"\\[{}$&#%_]|\\[a-z]+(?:\{\}|34)?", "", escaped).replace("ensuremath", "")
    assert not set(bare) & set('$&#%_~"`<>|\\')
    assert bare.count("{") == bare.count("}")
    assert "\n" not in escaped


KEYS = st.lists(st.tuples(st.text(max_size=4), st.text(max_size=4)), unique=True, max_size=30)


@given(KEYS)
def test_macro_names_are_letters_and_never_shared(keys: list[tuple[str, str]]) -> None:
    names = macro_names(keys)
    assert all(re.fullmatch("[A-Za-z]+", name) for name in names)
    assert len(set(names)) == len(keys)


def test_macros_that_would_fall_together_stay_apart() -> None:
    names = macro_names([("a-1", "b"), ("a_1", "b"), ("a1", "b"), ("c", "b")])
    assert len(set(names)) == 4
    assert names[3] == "sidCB"


def test_comments_cannot_be_left(table: Table) -> None:
    origin = Origin("run\n\\evil", "x\r\n\\evil", "y\u2028\\evil")
    head = to_latex(table, origin).split("\\begin{table")[0]
    assert all(line.startswith("%") for line in head.splitlines())


def test_emitted_latex_compiles(table: Table, hostile: Table, tmp_path: Path) -> None:
    tex = "".join(to_latex(made, ORIGIN) for made in (table, hostile))
    assert compiled(standalone(tex), tmp_path).stat().st_size > 1000


def test_every_layout_compiles(cells: pd.DataFrame, tmp_path: Path) -> None:
    tex = ""
    for metric, columns, interval in (
        ("torque_error", [], "std"), ("rmse_test", ["estimator"], "ci95"), ("rank", [], "range"),
        ("condition", ["task", "noise", "estimator"], "iqr"), ("gap", ["payload"], "none"),
        ("feasible", ["estimator"], "none"),
    ):  # fmt: skip
        spec = {"name": metric, "rows": ["robot"], "columns": columns, "best": "max-bold",
                "cells": {"metric": metric, "stat": "mean", "interval": interval}}  # fmt: skip
        tex += to_latex(build_table(cells, spec), ORIGIN)
    compiled(standalone(tex), tmp_path)


def test_prose_can_use_every_number(table: Table, hostile: Table, tmp_path: Path) -> None:
    macros = macro_text([table, hostile], ORIGIN)
    names = re.findall(r"\\newcommand\{(\\[A-Za-z]+)\}", macros)
    assert len(names) == sum(len(made.indices) for made in (table, hostile))
    compiled(standalone(macros + "\n".join(f"{name}\n" for name in names)), tmp_path)


STYLES = ("booktabs.sty", "siunitx.sty", "lmodern.sty")


@cache
def _missing_tex() -> str:
    """The first tool or style file that compiling needs and this machine lacks; "" for none."""
    for tool in ("pdflatex", "kpsewhich"):
        if shutil.which(tool) is None:
            return tool
    lacks = (
        name
        for name in STYLES
        if subprocess.run(["kpsewhich", name], capture_output=True, check=False).returncode
    )
    return next(lacks, "")


def compiled(tex: str, folder: Path) -> Path:
    """The PDF of a document; a missing compiler or style is a skip here and a failure on CI."""
    missing = _missing_tex()
    if missing and os.environ.get("CI") == "true":
        pytest.fail(f"{missing} is not installed: emitted LaTeX must be compiled on CI.")
    if missing:
        pytest.skip(f"{missing} is not installed")
    (folder / "t.tex").write_text(tex, encoding="utf-8")
    command = ["pdflatex", "-halt-on-error", "-interaction=nonstopmode", "t.tex"]
    done = subprocess.run(command, cwd=folder, capture_output=True, timeout=120, check=False)
    assert done.returncode == 0, done.stdout.decode(errors="replace")[-2000:]
    return folder / "t.pdf"
