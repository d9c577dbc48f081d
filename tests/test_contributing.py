"""Each recipe of CONTRIBUTING.md is complete: its files alone make its commands run."""

import os
import re
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
SECTION = re.compile(r"^### (.+)$", re.MULTILINE)
BLOCK = re.compile(r"^```(\w+)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
FILE = re.compile(r"^# file: (\S+)\n")
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
        blocks = BLOCK.findall(text.partition("\n## ")[0])
        files = {match[1]: block for _, block in blocks if (match := FILE.match(block))}
        lines = [line for kind, block in blocks if kind == "sh" for line in block.splitlines()]
        if blocks:
            found.append(Recipe(title, files, tuple(filter(None, lines))))
    return found


RECIPES = recipes()


def executables(folder: Path) -> dict[str, str]:
    """Environment with `sysid-bench` and `python` of this interpreter on the path."""
    scripts = folder / ".bin"
    scripts.mkdir()
    for name, arguments in (("sysid-bench", "-m sysid_bench "), ("python", "")):
        script = scripts / name
        script.write_text(f'#!/bin/sh\nexec "{sys.executable}" {arguments}"$@"\n')
        script.chmod(0o755)
    path = f"{scripts}{os.pathsep}{os.environ['PATH']}"
    return {**os.environ, "PATH": path, "PYTHONPATH": str(ROOT)}


@pytest.mark.long
@pytest.mark.parametrize("recipe", RECIPES, ids=lambda recipe: recipe.title)
def test_a_recipe_runs_as_printed(recipe: Recipe, tmp_path: Path) -> None:
    for name, text in recipe.files.items():
        file = tmp_path / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text, encoding="utf-8")
    environment = executables(tmp_path)
    for command in recipe.commands:
        done = subprocess.run(
            ["sh", "-c", command],
            cwd=tmp_path,
            env=environment,
            text=True,
            capture_output=True,
            timeout=300,
            check=False,
        )
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
