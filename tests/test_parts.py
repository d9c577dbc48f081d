"""Parts of the checks that changed files need: no file is left out, and code runs its tests."""

import importlib.util
import re
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).parents[1]


def program() -> ModuleType:
    spec = importlib.util.spec_from_file_location("ci_parts", ROOT / ".ci" / "parts.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


PARTS = program()


def tracked() -> list[str]:
    done = subprocess.run(["git", "ls-files"], cwd=ROOT, text=True, capture_output=True)
    if done.returncode:
        pytest.skip("This is no checkout of git.")
    return done.stdout.splitlines()


def test_every_rule_names_files_that_there_are_and_targets_of_make() -> None:
    files, make = tracked(), (ROOT / "Makefile").read_text(encoding="utf-8")
    for rule, parts in PARTS.RULES:
        assert any(f == rule or (rule.endswith("/") and f.startswith(rule)) for f in files), rule
        assert set(parts) <= set(PARTS.PARTS)
    for part in PARTS.PARTS:
        assert f"\n{part}:" in make


def test_a_file_that_no_rule_names_needs_every_part() -> None:
    assert PARTS.parts_of(["new/thing.c"]) == list(PARTS.PARTS)
    assert PARTS.parts_of(["pyproject.toml"]) == list(PARTS.PARTS)
    assert PARTS.parts_of([]) == []


@pytest.mark.parametrize("file", [f for f in tracked() if f.startswith("sysid_bench/")][::40])
def test_code_of_the_package_runs_tests_and_gates(file: str) -> None:
    assert {"test", "long", "gate", "lint"} <= set(PARTS.parts_of([file]))


def test_the_first_rule_decides_and_parts_add_up() -> None:
    assert PARTS.parts_of(["docs/cite.md", "tests/faults/test_runs.py"]) == [
        *("test", "long", "faults", "docs", "lint")
    ]
    assert "cluster" in PARTS.parts_of(["sysid_bench/harness/run.py"])
    assert "cluster" not in PARTS.parts_of(["sysid_bench/errors.py"])


def test_the_program_prints_targets() -> None:
    tracked()
    done = subprocess.run(
        [sys.executable, ".ci/parts.py", "HEAD"], cwd=ROOT, text=True, capture_output=True
    )
    assert done.returncode == 0, done.stderr
    assert set(done.stdout.split()) <= set(PARTS.PARTS)
    assert done.stdout.strip()
    lost = subprocess.run(
        [sys.executable, ".ci/parts.py", "no-such"], cwd=ROOT, text=True, capture_output=True
    )
    assert lost.stdout.split() == list(PARTS.PARTS), "without history every part runs"


IMPORT = re.compile(r"^\s*(?:from|import) (tests\.[\w.]+|harness_world)", re.MULTILINE)
FOLDER = {"faults": "faults", "cluster": "cluster", "bench": "benchmarks"}


@pytest.mark.parametrize("part", FOLDER)
def test_what_a_part_imports_from_other_tests_runs_it(part: str) -> None:
    files = [*(ROOT / "tests" / FOLDER[part]).glob("*.py"), ROOT / "tests" / "conftest.py"]
    found = {name for file in files for name in IMPORT.findall(file.read_text(encoding="utf-8"))}
    for module in found:
        place = module.replace(".", "/") if "." in module else f"tests/harness/{module}"
        place += "/__init__.py" if (ROOT / place).is_dir() else ".py"
        assert part in PARTS.parts_of([place]), place


READ = re.compile(r"""["'](\.github/workflows/\w+\.yml|mkdocs\.yml|[A-Z]+\.md|docs/[\w./-]+\.md)""")


def test_what_quick_tests_read_runs_them() -> None:
    """By the names that stand in them; of folders, one file stands for all."""
    files = [f for f in tracked() if f.startswith("tests/") and f.endswith(".py")]
    texts = [(ROOT / f).read_text(encoding="utf-8") for f in files]
    read = {name for text in texts for name in READ.findall(text) if (ROOT / name).is_file()}
    assert {"docs/cite.md", "mkdocs.yml", "README.md"} <= read
    for name in (*read, "docs/index.md", "reports/reference/smoke.md", "reports/make/kept_rows.py"):
        assert "test" in PARTS.parts_of([name]), name
