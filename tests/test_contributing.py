"""Each recipe of CONTRIBUTING.md is complete: its files alone make its commands run."""

import re
from dataclasses import dataclass
from pathlib import Path

import pytest

from tests.printed_commands import FILE, blocks, place, run_line

ROOT = Path(__file__).parents[1]
SECTION = re.compile(r"^### (.+)$", re.MULTILINE)
LONGEST = 25
"""Lines of a file in a recipe."""


@dataclass(frozen=True)
class Recipe:
    """Files by name and commands of one section."""

    title: str
    files: dict[str, str]
    commands: tuple[str, ...]


def recipes() -> list[Recipe]:
    """Sections of CONTRIBUTING.md with fenced examples."""
    parts = SECTION.split((ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8"))[1:]
    found = []
    for title, text in zip(parts[::2], parts[1::2], strict=True):
        found_blocks = blocks(text.partition("\n## ")[0])
        files = {match[1]: block for _, block in found_blocks if (match := FILE.match(block))}
        lines = [
            line for kind, block in found_blocks if kind == "sh" for line in block.splitlines()
        ]
        if found_blocks:
            found.append(Recipe(title, files, tuple(filter(None, lines))))
    return found


RECIPES = recipes()


@pytest.mark.long
@pytest.mark.parametrize("recipe", RECIPES, ids=lambda recipe: recipe.title)
def test_a_recipe_runs_as_printed(recipe: Recipe, tmp_path: Path) -> None:
    for text in recipe.files.values():
        place(tmp_path, text)
    for command in recipe.commands:
        done = run_line(command, tmp_path)
        assert done.returncode == 0, f"{command}: {done.stdout}\n{done.stderr}"


@pytest.mark.parametrize("recipe", RECIPES, ids=lambda recipe: recipe.title)
def test_a_recipe_is_short_and_checked(recipe: Recipe) -> None:
    assert recipe.files
    assert recipe.commands
    for name, text in recipe.files.items():
        assert len(text.splitlines()) <= LONGEST, f"{name} is long; simplify the example."


def test_the_kinds_with_a_kit_have_a_recipe() -> None:
    titles = {recipe.title for recipe in RECIPES}
    assert {"A robot", "A payload", "An estimator", "An excitation", "A plant effect"} <= titles


def test_files_that_contributing_names_exist() -> None:
    text = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    named = set(re.findall(r"`((?:sysid_bench|tests)/[\w/]+\.py)`", text))
    assert named
    for path in named:
        assert (ROOT / path).is_file(), path
