"""Mutations of the code itself, drawn by a seed: which of them do the tests of their module miss?

python -m tests.faults.code_mutations comparison --seed 37 --count 25 prints the survivors. A child
process for each mutation reads the changed module in place of the file and runs the quick tests of
its group; files on the disk stay as they are.
"""

import argparse
import ast
import importlib.machinery
import os
import random
import sys
import time
from collections.abc import Iterator
from contextlib import suppress
from copy import deepcopy
from pathlib import Path
from typing import Final

ROOT: Final = Path(__file__).parents[2]
PACKAGE: Final = ROOT / "sysid_bench"
GROUPS: Final[dict[str, tuple[str, str]]] = {
    "comparison": ("harness/comparison/*.py", "tests/comparison"),
    "gate": ("commands/baseline.py", "tests/cli/test_gate.py"),
    "statistics": (
        "evaluation/robot_statistic.py evaluation/repeat_statistic.py reporting/claims.py "
        "reporting/ranking.py",
        "tests/evaluation/test_claim_statistic.py tests/evaluation/test_ranking_statistic.py "
        "tests/evaluation/test_statistics.py tests/reporting/test_claims.py "
        "tests/reporting/test_report_rankings.py",
    ),
    "staleness": (
        "harness/fingerprint.py",
        "tests/harness/test_fingerprint.py tests/faults/test_staleness.py",
    ),
    "units": ("units.py", "tests/test_units.py"),
}
_COMPARED: Final = {
    ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.GtE, ast.GtE: ast.Gt, ast.Eq: ast.NotEq,
    ast.NotEq: ast.Eq, ast.In: ast.NotIn, ast.NotIn: ast.In, ast.Is: ast.IsNot, ast.IsNot: ast.Is,
}  # fmt: skip
_COUNTED: Final = {
    ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult, ast.Pow: ast.Mult,
    ast.BitOr: ast.BitAnd, ast.BitAnd: ast.BitOr,
}  # fmt: skip
_CALLED: Final = {"min": "max", "max": "min", "any": "all", "all": "any", "abs": "float"}


def changes(node: ast.AST) -> Iterator[ast.AST]:
    """Yield the changed copies of a node: comparisons, signs, tolerances, indices."""
    new = deepcopy(node)
    if isinstance(new, ast.Compare):
        new.ops[0] = _COMPARED[type(new.ops[0])]()
    elif isinstance(new, ast.BinOp) and type(new.op) in _COUNTED:
        new.op = _COUNTED[type(new.op)]()
    elif isinstance(new, ast.BoolOp):
        new.op = ast.Or() if isinstance(new.op, ast.And) else ast.And()
    elif isinstance(new, ast.UnaryOp) and isinstance(new.op, (ast.USub, ast.Not)):
        new = new.operand
    elif isinstance(new, ast.Constant) and type(new.value) is int:
        new.value += 1
    elif isinstance(new, ast.Constant) and type(new.value) is float:
        new.value = new.value * 100.0 + (new.value == 0.0)
    elif isinstance(new, ast.Call) and isinstance(new.func, ast.Name) and new.func.id in _CALLED:
        new.func.id = _CALLED[new.func.id]
    else:
        return
    yield new


def mutants(file: Path) -> list[tuple[str, str]]:
    """Return (description, changed text) of every mutation of a file; annotations stay."""
    tree = ast.parse(file.read_text(encoding="utf-8"))
    found = []
    for parent in ast.walk(tree):
        for field, value in ast.iter_fields(parent):
            if field in ("annotation", "returns"):
                continue
            for place, node in enumerate(value if isinstance(value, list) else [value]):
                for new in changes(node) if isinstance(node, ast.AST) else ():
                    old = ast.unparse(node)
                    where = f"{file.relative_to(PACKAGE)}:{getattr(node, 'lineno', 0)}"
                    _put(parent, field, place, new)
                    text = ast.unparse(ast.fix_missing_locations(tree))
                    _put(parent, field, place, node)
                    found.append((f"{where}: {old} -> {ast.unparse(new)}", text))
    return found


def _put(parent: ast.AST, field: str, place: int, node: ast.AST) -> None:
    value = getattr(parent, field)
    if isinstance(value, list):
        value[place] = node
    else:
        setattr(parent, field, node)


def survives(file: Path, text: str, tests: list[str], log: Path, seconds: float) -> bool:
    """True where all tests pass with `text` in place of a module, which is not imported yet."""
    child = os.fork()
    if child == 0:
        output = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        os.dup2(output, 1)
        os.dup2(output, 2)
        loader = importlib.machinery.SourceFileLoader
        read, stats = loader.get_data, loader.path_stats

        def get_data(self: importlib.machinery.SourceFileLoader, path: str) -> bytes:
            return text.encode() if Path(path) == file else read(self, path)

        def path_stats(self: importlib.machinery.SourceFileLoader, path: str) -> object:
            if Path(path) == file:
                raise OSError  # no bytecode of the file as it was
            return stats(self, path)

        loader.get_data, loader.path_stats = get_data, path_stats  # type: ignore[method-assign, assignment]
        import pytest

        options = [
            "-x",
            "-q",
            "-n",
            "0",
            "-m",
            "not long and not tutorial",
            "-p",
            "no:cacheprovider",
        ]
        os._exit(int(pytest.main([*options, *tests])))
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        done, status = os.waitpid(child, os.WNOHANG)
        if done:
            return os.waitstatus_to_exitcode(status) == 0
        time.sleep(0.1)
    with suppress(ProcessLookupError):  # a loop without end is found, too
        os.kill(child, 9)
        os.waitpid(child, 0)
    return False


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("group", choices=GROUPS)
    parser.add_argument("--seed", type=int, default=37)
    parser.add_argument("--count", type=int, default=25)
    parser.add_argument("--seconds", type=float, default=300.0)
    given = parser.parse_args()
    for name in (
        "numpy",
        "scipy.stats",
        "scipy.linalg",
        "pandas",
        "hypothesis",
        "pytest",
        "mujoco",
    ):
        __import__(name)
    sys.dont_write_bytecode = True
    os.chdir(ROOT)
    patterns, tests = GROUPS[given.group]
    files = sorted(file for pattern in patterns.split() for file in PACKAGE.glob(pattern))
    every = [(file, *mutant) for file in files for mutant in mutants(file)]
    log, missed = Path(f"/tmp/mutation-{given.group}.log"), 0
    plain = files[0].read_text(encoding="utf-8")
    assert survives(files[0], plain, tests.split(), log, given.seconds), f"tests fail, see {log}"
    for file, what, text in random.Random(given.seed).sample(every, given.count):
        lives = survives(file, text, tests.split(), log, given.seconds)
        missed += lives
        print(f"{'SURVIVES' if lives else 'caught  '} {what}", flush=True)
    print(
        f"{given.group}: {given.count - missed} of {given.count} caught (of {len(every)} mutations)"
    )


if __name__ == "__main__":
    main()
