"""Law: damaged input of every kind is accepted or refused in a sentence: no traceback, hang, crash
or unbounded memory. `python -m tests.faults.fuzz` tries as many inputs as are wanted."""

from pathlib import Path

import pytest

from sysid_bench.errors import UsageError
from tests.faults.fuzz import HARMLESS, fuzz, isolated
from tests.faults.fuzz_kind import Kind
from tests.faults.fuzz_kinds import KINDS

RUNS = ("plan.jsonl", "run.toml", "env.json", "run-parquet")
"""Kinds of which each input costs seconds: rows stand for them."""


@pytest.mark.parametrize(
    "kind", [k for k in KINDS if k.name not in RUNS], ids=lambda kind: kind.name
)
def test_damaged_input_is_accepted_or_refused(kind: Kind) -> None:
    verdicts = list(fuzz(kind, range(3), seed=1))
    assert len(verdicts) == 3
    assert [verdict for verdict in verdicts if verdict.outcome not in HARMLESS] == []


def test_the_fuzzer_sees_every_harm() -> None:
    def allocate() -> None:
        _ = b"x" * (4 * 2**30)

    def loop() -> None:
        while True:
            pass

    def refuse(text: str) -> None:
        raise UsageError(text)

    assert isolated(allocate)[0] == "memory"
    assert isolated(loop, seconds=1)[0] == "hang"
    assert isolated(lambda: Path("/absent").read_text())[0] == "traceback"
    assert isolated(lambda: __import__("os").abort())[0] == "crash"
    assert isolated(lambda: refuse("No."))[0] == "refused"
    assert isolated(lambda: refuse(""))[0] == "message"
    assert isolated(lambda: None)[0] == "accepted"
