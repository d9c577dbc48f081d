"""The check of the reference pages finds what was planted, in each place."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from reports.make import page_sources
from reports.make.page_numbers import problems
from reports.make.page_sources import changed, sources
from reports.make.reference_check import Made, found_in, made_part, with_declaration

RUN, TABLE = "sysid-bench run smoke", "sysid-bench table reports/smoke errors"
STAMP = "```\nsysid-bench run smoke\n```\n\n3 cells. Commit 0123abcd, Python 3.11.7; 2026-01-01."
CELLS = """**Errors**

| robot | ols | wls |
| --- | ---: | ---: |
| ur5 | 0.1234 | 0.0512 \\[0.04, 0.06\\] |
| panda | 0.310 | 0.0512 |
"""
PAGE = f"""# Page

Weights halve the error, from 0.123<!-- is: ur5 | ols --> to 0.051<!-- is: ur5 | wls -->,
at 100 Hz.

<!-- given: 100 -->

<!-- made by: {RUN} -->
{STAMP}

<!-- end -->

<!-- made by: {TABLE} -->
{CELLS}
<!-- end -->
"""


@pytest.fixture(scope="module")
def made() -> list[Made]:
    return [made_part(RUN, STAMP, "0123abcd" * 5), made_part(TABLE, CELLS, "0123abcd" * 5)]


def test_a_page_as_it_was_made_has_no_fault(made: list[Made]) -> None:
    assert not found_in("page", PAGE, made)


PLANTED: dict[str, Callable[[str], str]] = {
    "ur5 | ols": lambda text: text.replace("0.123<", "0.124<"),
    "ur5 | wls": lambda text: text.replace("0.051<", "0.15<"),
    "99 is bound to no cell": lambda text: text.replace("at 100 Hz", "at 99 Hz"),
    "100 is given 1 times too often": lambda text: text.replace("at 100 Hz", ""),
    "with changes": lambda text: text.replace("0123abcd", "0123abcd with changes"),
    "not what the command printed": lambda text: text.replace("2026-01-01", "2026-02-01"),
    "states commit 9999abcd": lambda text: text.replace("0123abcd", "9999abcd"),
    f"{TABLE}'": lambda text: text.replace("| panda | 0.310", "| panda | 0.210"),
    "is no part": lambda text: text.replace(TABLE, "sysid-bench table reports/smoke other"),
    "2 cells have these words": lambda text: text.replace("is: ur5 | wls", "is: wls"),
    "0 cells have these words": lambda text: text.replace("is: ur5 | wls", "is: ur3 | wls"),
    "they are as they were": lambda text: with_declaration("page", text, {"signals"}),
}


@pytest.mark.parametrize("words", PLANTED)
def test_a_planted_fault_is_found(words: str, made: list[Made]) -> None:
    assert PLANTED[words](PAGE) != PAGE
    assert any(words in one for one in found_in("page", PLANTED[words](PAGE), made))


@pytest.mark.parametrize("part", [0, 1])
def test_a_page_older_than_its_code_says_so(part: int, made: list[Made]) -> None:
    old = list(made)
    old[part] = replace(
        made[part], sources={**(made[part].sources or {}), "evaluation": "00000000"}
    )
    assert ["changes of evaluation" in one for one in found_in("page", PAGE, old)] == [True]
    said = with_declaration("page", PAGE, {"evaluation"})
    assert not found_in("page", said, old)
    assert with_declaration("page", said, set()) == PAGE


def test_copied_figures_are_declared_by_named_pages_alone() -> None:
    text = "# Page\n\nThree of 17.\n"
    said = text + "\nIts figures are of commit 0123abcd and are checked by no command.\n"
    assert not found_in("speed", said, [])
    assert len(found_in("speed", text, [])) == 1
    assert len(found_in("page", text, [])) == len(found_in("page", said, [])) == 2


def test_a_part_that_was_not_made_again_keeps_its_text(made: list[Made]) -> None:
    part = "```\nx\n```\n\nNot made again since commit 0123abcd: hours.\n"
    old = [replace(made_part(RUN, part, "0123abcd"), sources=None), made[1]]
    page = PAGE.replace(STAMP, part.strip())
    assert not found_in("page", page, old)
    assert found_in("page", page.replace("hours", "minutes"), old)
    assert found_in("page", PAGE, old)


def test_each_of_two_parts_of_a_command_is_checked(made: list[Made]) -> None:
    copy = f"<!-- made by: {TABLE} -->\n{CELLS.replace('0.310', '0.210')}\n<!-- end -->\n\n"
    start = f"<!-- made by: {TABLE}"
    for page in (PAGE.replace(start, copy + start), PAGE + "\n" + copy):
        assert len(found_in("page", page, made)) >= 2


@pytest.mark.parametrize(
    "words", ["2x", "3ms", "[0.9, 1.2]", "in 2024", "1:50", "0<!-- is: ur5 | ols -->",
              "0.06<!-- is: ur5 | wls -->", "-0<!-- is: ur5 | ols -->"],
)  # fmt: skip
def test_a_number_is_seen_wherever_it_stands(words: str) -> None:
    assert problems(PAGE + f"\nIt errs {words} more.\n")
    assert not problems(PAGE + "\n0.06<!-- is: ur5 | wls #3 --> on 2026-11-24 (Gautier 1997).\n")


@pytest.mark.parametrize("number", ["0.31", "0.310", "3.1e-1", "0.3"])
def test_a_number_is_that_of_its_cell_in_its_own_digits(number: str) -> None:
    text = PAGE + f"\nAlso {number}<!-- is: panda | ols -->.\n"
    assert not problems(text)
    assert problems(text.replace("panda | ols", "panda | wls"))


def test_words_and_layout_are_no_change_of_the_code(tmp_path: Path) -> None:
    module = tmp_path / "reports" / "make" / "page.py"
    module.parent.mkdir(parents=True)
    (tmp_path / "constraints.txt").write_text("numpy==2.0\nruff==1.0\n")

    def of(text: str, pins: str = "numpy==2.0\nruff==1.0\n") -> dict[str, str]:
        module.write_text(text)
        (tmp_path / "constraints.txt").write_text(pins)
        for cached in (page_sources._code, page_sources._module):
            cached.cache_clear()
        return sources("python -m reports.make.page", tmp_path)

    first = of('"""Title."""\nx = 1\n')
    assert not changed(first, of('"""Other."""\n\nx = (1)  # why\n'))
    assert not changed(first, of("x = 1\n", "numpy==2.0\nruff==2.0\n"))
    assert changed(first, of("x = 2\n")) == {"reports.make.page"}
    assert changed(first, of("x = 1\n", "numpy==2.1\n")) == {"constraints.txt"}


def test_a_run_depends_on_its_suite_its_robots_and_its_methods() -> None:
    found = sources(RUN)
    assert {"identification", "suites/smoke.toml", "robots/ur5", "constraints.txt"} <= found.keys()
    assert not {"commands", "diagnosis"} & found.keys()
    assert sources("sysid-bench run claims/rows")["suites/claims/rows.toml"]
