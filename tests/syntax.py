"""The files of the package, and the nodes of their syntax, which a process reads once."""

import ast
from functools import cache
from pathlib import Path

ROOT = Path(__file__).parents[1] / "sysid_bench"
FILES = sorted(ROOT.rglob("*.py"))


@cache
def nodes(file: Path) -> tuple[ast.AST, ...]:
    """The nodes of a file's syntax tree."""
    return tuple(ast.walk(ast.parse(file.read_text(encoding="utf-8"))))
