"""Mutations of the code itself, drawn by a seed: which of them do the tests of their module miss?

python -m tests.faults.code_mutations comparison --seed 37 101 --count 25 prints the survivors. A
child process for each mutation reads the changed module in place of the file, and so do those that
it starts; files on the disk stay as they are. It runs the tests that call the changed function, the
quickest first, and those that remain where all of them pass. Types are not mutated (annotations,
and unions with None or a class): mypy checks them. No other mutation is left out.
"""

import argparse
import ast
import json
import os
import random
import sys
import time
from collections.abc import Generator, Iterator
from contextlib import suppress
from copy import deepcopy
from itertools import chain
from pathlib import Path
from types import FrameType
from typing import Final

import hypothesis
import pytest

ROOT: Final = Path(__file__).parents[2]
PACKAGE: Final = ROOT / "sysid_bench"
GROUPS: Final[dict[str, tuple[str, str]]] = {
    "comparison": (
        "harness/comparison/run_difference.py harness/comparison/run_values.py "
        "harness/comparison/speed.py",
        "tests/comparison",
    ),
    "gate": (
        "harness/comparison/baseline.py harness/comparison/drift.py commands/baseline.py "
        "commands/gate.py models/behaviour.py models/behaviour_change.py",
        "tests/comparison/test_baseline.py tests/comparison/test_drift.py "
        "tests/models/test_behaviour.py tests/cli/test_gate.py",
    ),
    "statistics": (
        "evaluation/robot_statistic.py evaluation/repeat_statistic.py reporting/claims.py "
        "reporting/ranking.py",
        "tests/evaluation/test_claim_statistic.py tests/evaluation/test_ranking_statistic.py "
        "tests/evaluation/test_repeat_statistic.py tests/reporting/test_claims.py "
        "tests/evaluation/test_statistics.py "
        "tests/reporting/test_report_rankings.py",
    ),
    "staleness": (
        "harness/fingerprint.py "
        "models/sources.py:_FILE,_FOLDER,_PICTURES,file_state,model_states "
        "experiments/third_party.py:loaded_sources,_state,stale_sources,_present,_owners,"
        "_top_modules,_required,_canonical",
        "tests/harness/test_fingerprint.py tests/faults/test_staleness.py",
    ),
    "units": ("units.py", "tests/test_units.py"),
}
"""Code (`file:names`: these functions alone), and its tests in the order of their time: the first
failure ends a run."""
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


def mutants(file: Path, names: str = "") -> list[tuple[str, str]]:
    """Return (description, changed text) of every mutation of a file, or of some `names` in it;
    types stay."""
    tree = ast.parse(file.read_text(encoding="utf-8"))
    found = []
    parts = [part for part in tree.body if not names or _name(part) in names.split(",")]
    for parent in chain.from_iterable(map(_code, parts)):
        for field, value in ast.iter_fields(parent):
            if field in ("annotation", "returns"):
                continue
            for place, node in enumerate(value if isinstance(value, list) else [value]):
                for new in () if not isinstance(node, ast.AST) or _is_type(node) else changes(node):
                    old = ast.unparse(node)
                    where = f"{file.relative_to(PACKAGE)}:{getattr(node, 'lineno', 0)}"
                    _put(parent, field, place, new)
                    text = ast.unparse(ast.fix_missing_locations(tree))
                    _put(parent, field, place, node)
                    found.append((f"{where}: {old} -> {ast.unparse(new)}", text))
    return found


def _name(part: ast.stmt) -> str:
    """Name of a function, class or constant of a module."""
    target = part.target if isinstance(part, ast.AnnAssign) else part
    return str(getattr(target, "name", getattr(target, "id", "")))


def _code(node: ast.AST) -> Iterator[ast.AST]:
    """Yield a node and all below it but types."""
    yield node
    for field, value in ast.iter_fields(node):
        if field not in ("annotation", "returns"):
            for child in value if isinstance(value, list) else [value]:
                if isinstance(child, ast.AST) and not _is_type(child):
                    yield from _code(child)


def _is_type(node: object) -> bool:
    """True for `A | None` and `A | str`: no number and no set is None or a built-in class."""
    return (
        isinstance(node, ast.BinOp)
        and isinstance(node.op, ast.BitOr)
        and ast.unparse(node.right) in ("None", "str", "float", "int", "Array")
    )


def _put(parent: ast.AST, field: str, place: int, node: ast.AST) -> None:
    value = getattr(parent, field)
    if isinstance(value, list):
        value[place] = node
    else:
        setattr(parent, field, node)


HOOK: Final = """
from importlib.machinery import SourceFileLoader as loader
def get_data(self, path, read=loader.get_data):
    return {text!r} if path == {file!r} else read(self, path)
def path_stats(self, path, stats=loader.path_stats):
    if path == {file!r}:
        raise OSError  # no bytecode of the file as it was
    return stats(self, path)
loader.get_data, loader.path_stats = get_data, path_stats
"""
"""A process that runs it reads `text` in place of a module, which it has not imported yet."""


class Calls:
    """Plug-in of pytest: which tests call which functions of some files, and how long they take."""

    def __init__(self, files: set[str], out: Path) -> None:
        self.files, self.out = files, out
        self.found: dict[str, list[tuple[str, int]]] = {}
        self.seconds: dict[str, float] = {}

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_protocol(self, item: pytest.Item) -> Generator[None, object, object]:
        seen: set[tuple[str, int]] = set()

        def note(frame: FrameType, event: str, argument: object) -> None:
            if event == "call" and frame.f_code.co_filename in self.files:
                seen.add((frame.f_code.co_filename, frame.f_code.co_firstlineno))

        start = time.perf_counter()
        sys.setprofile(note)
        try:
            return (yield)
        finally:
            sys.setprofile(None)
            self.found[item.nodeid] = sorted(seen)
            self.seconds[item.nodeid] = time.perf_counter() - start

    def pytest_sessionfinish(self) -> None:
        quickest = sorted(self.found, key=self.seconds.__getitem__)
        self.out.write_text(json.dumps({name: self.found[name] for name in quickest}))


def passes(change: tuple[Path, str] | Calls, tests: list[str], log: Path, seconds: float) -> bool:
    """True where all tests pass: with a text in place of a module, also in processes that they
    start; or as it is, under a plug-in."""
    child = os.fork()
    if child == 0:
        os.setpgid(0, 0)
        output = os.open(log.with_suffix(".log"), os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        os.dup2(output, 1)
        os.dup2(output, 2)
        if not isinstance(change, Calls):
            hook = HOOK.format(text=change[1].encode(), file=str(change[0]))
            (log / "sitecustomize.py").write_text(hook, encoding="utf-8")
            os.environ["PYTHONPATH"] = str(log)
            exec(hook)
        options = ["-x", "-q", "-n", "0", "-p", "no:cacheprovider"]
        options += ["--hypothesis-profile=mutations", "-m", "not long and not tutorial"]
        plugins = [change] if isinstance(change, Calls) else []
        os._exit(int(pytest.main([*options, *tests], plugins)))
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        done, status = os.waitpid(child, os.WNOHANG)
        if done:
            return os.waitstatus_to_exitcode(status) == 0
        time.sleep(0.05)
    with suppress(ProcessLookupError):  # a loop without end is found, too
        os.killpg(child, 9)
        os.waitpid(child, 0)
    return False


def callers(file: Path, line: int, calls: dict[str, list[tuple[str, int]]]) -> list[str]:
    """Tests that call the function or method around a line, the quickest first."""
    tree = ast.parse(file.read_text(encoding="utf-8"))
    functions = [part for part in ast.walk(tree) if isinstance(part, ast.FunctionDef)]
    ranges = [
        (min([part.lineno, *(one.lineno for one in part.decorator_list)]), part.end_lineno or 0)
        for part in functions
    ]
    around = [(first, last) for first, last in ranges if first <= line <= last]
    if not around:
        return []
    first, last = min(around)  # the outermost: what is defined in it has calls of its own
    return [
        test for test, found in calls.items()
        if any(name == str(file) and first <= number <= last for name, number in found)
    ]  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("group", choices=GROUPS)
    parser.add_argument("--seed", type=int, nargs="+", default=[37])
    parser.add_argument("--count", type=int, default=25)
    given = parser.parse_args()
    for name in ["numpy", "scipy.stats", "scipy.linalg", "pandas", "mujoco"]:
        __import__(name)
    # The same examples for each mutation, and the first that fails is not made small.
    phases = (hypothesis.Phase.explicit, hypothesis.Phase.generate)
    hypothesis.settings.register_profile(
        "mutations", deadline=None, derandomize=True, database=None, phases=phases
    )
    sys.dont_write_bytecode = True
    os.chdir(ROOT)
    code, tests = GROUPS[given.group]
    every = []
    for pattern, _, names in (part.partition(":") for part in code.split()):
        every += [(PACKAGE / pattern, *mutant) for mutant in mutants(PACKAGE / pattern, names)]
    log, start = Path(f"/tmp/mutation-{given.group}"), time.monotonic()
    log.mkdir(exist_ok=True)
    plain = Calls({str(file) for file, _, _ in every}, log / "calls.json")
    assert passes(plain, tests.split(), log, 1800.0), f"tests fail, see {log}.log"
    calls = json.loads(plain.out.read_text())
    longest = 10.0 + 4.0 * (time.monotonic() - start)
    for seed in given.seed:
        missed = 0
        for file, what, text in random.Random(seed).sample(every, given.count):
            first = callers(file, int(what.split(":")[1]), calls)
            # What starts in a fixture belongs to all tests: those that pass are followed by all.
            lives = all(
                passes((file, text), chosen, log, longest)
                for chosen in (first, tests.split())
                if chosen
            )
            missed += lives
            print(f"{'SURVIVES' if lives else 'caught  '} {what}", flush=True)
        print(
            f"{given.group}, seed {seed}: {given.count - missed} of {given.count} caught "
            f"(of {len(every)} mutations)",
            flush=True,
        )


if __name__ == "__main__":
    main()
