"""Markdown drawn for a terminal: nothing is lost, nothing is wider than the screen."""

import random
import re

import pytest

from sysid_bench.reporting.terminal import plain_text, table_cells, table_lines, terminal_text

TABLE = r"""**Held-out error, "a\_b" \[N m\]**

| robot | wls / tau \| q | ols |
| --- | ---: | ---: |
| ur5 | **1.50e-3** \[1.1e-3, 1.5e-3\] | 2.22e-3 |
| panda | 1.10e-2 | failed (a) |

(a) 3 of 3 cells give no number: 3 failed.
"""


def test_numbers_are_aligned_and_the_best_is_marked() -> None:
    title, table, note = terminal_text(TABLE, 80).split("\n\n")
    assert title == 'Held-out error, "a_b" [N m]'
    assert table.splitlines() == [
        "robot              wls / tau | q         ols",
        "────────────────────────────────────────────",
        "ur5    1.50e-3* [1.1e-3, 1.5e-3]     2.22e-3",
        "panda                   1.10e-2   failed (a)",
        "* best of those that compete",
    ]
    assert note.startswith("(a) 3 of 3")


@pytest.mark.parametrize("seed", range(20))
@pytest.mark.parametrize("width", [30, 60, 120])
def test_every_cell_is_drawn_within_the_width(seed: int, width: int) -> None:
    """Numbers whole, words in order; parts repeat the columns before the first number."""
    draw = random.Random(seed)
    columns, keys = draw.randint(2, 9), draw.randint(1, 2)
    right = [i >= keys for i in range(columns)]
    head = [" ".join(f"h{i}{word}" for word in range(draw.randint(1, 4))) for i in range(columns)]
    rows = [
        [
            f"{draw.random() * 10 ** draw.randint(-9, 9):.3g}" if is_number else f"k{row} w{row}"
            for is_number in right
        ]
        for row in range(draw.randint(1, 6))
    ]
    text = table_lines(head, rows, right, width)
    assert max(map(len, text.splitlines())) <= width
    for part in text.split("\n\n"):
        assert part.splitlines()[-1].startswith(f"k{len(rows) - 1}")
    words = text.split()
    assert all(words.count(cell) >= 1 for row in rows for cell in row[keys:])
    assert all(word in words for title in head for word in title.split())


@pytest.mark.parametrize("width", [40, 80])
def test_long_words_of_prose_are_wrapped_in_their_column(width: int) -> None:
    rows = [["`key`", "a meaning of several words " * 4, "`code|bar`"]] * 2
    lines = ["| key | meaning | code |", "| --- | --- | --- |"]
    lines += [f"| {' | '.join(row)} |" for row in rows]
    drawn = terminal_text("\n".join(lines), width)
    assert max(map(len, drawn.splitlines())) <= width
    assert drawn.split().count("several") == 8
    assert "code|bar" in drawn


def test_cells_are_split_at_bars_that_are_neither_escaped_nor_code() -> None:
    assert table_cells(r"| a \| b | `c|d` |  |") == [r"a \| b", "`c|d`", ""]


def test_links_entities_and_escapes_read_as_they_print() -> None:
    assert plain_text(r"[`ols`](#ols) a \*b\* &lt;c&gt; `d_\e` **f**") == r"ols a *b* <c> d_\e f"


def test_code_headings_and_lists_are_kept() -> None:
    text = "# Title\n\n```\na  b\n\nc\n```\n\n- one " + "word " * 30 + "\n- two\n\n    W = 1  2\n"
    drawn = terminal_text(text, 50)
    assert drawn.startswith("Title\n═════\n\n    a  b\n    \n    c\n\n- one word")
    assert re.search(r"\n  word word", drawn)
    assert drawn.endswith("\n- two\n\n    W = 1  2\n")
