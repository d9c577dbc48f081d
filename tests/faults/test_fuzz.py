"""Law: damaged input of every kind is accepted or refused in a sentence: no traceback, hang, crash
or unbounded memory. `python -m tests.faults.fuzz` tries as many inputs as are wanted."""

import os
from functools import partial
from pathlib import Path

import pytest

from sysid_bench.errors import UsageError
from tests.faults.fuzz import HARMLESS, Verdict, fuzz, outcomes
from tests.faults.fuzz_kind import Kind
from tests.faults.fuzz_kinds import KINDS
from tests.faults.fuzz_runs import RUN_KINDS

RUNS = tuple(kind.name for kind in RUN_KINDS)
"""Kinds of one run folder, which is made once for all of them."""


def harm(kind: Kind, cases: range) -> list[Verdict]:
    verdicts = list(fuzz(kind, cases, seed=1))
    assert len(verdicts) == len(cases)
    return [verdict for verdict in verdicts if verdict.outcome not in HARMLESS]


@pytest.mark.parametrize(
    "kind", [k for k in KINDS if k.name not in RUNS], ids=lambda kind: kind.name
)
def test_damaged_input_is_accepted_or_refused(kind: Kind) -> None:
    assert harm(kind, range(3)) == []


def test_damaged_files_of_a_run_are_accepted_or_refused() -> None:
    assert [verdict for kind in RUN_KINDS for verdict in harm(kind, range(1))] == []


def test_the_fuzzer_sees_every_harm() -> None:
    def allocate() -> None:
        _ = b"x" * (4 * 2**30)

    def loop() -> None:
        while True:
            pass

    def refuse(text: str) -> None:
        raise UsageError(text)

    def absent() -> None:
        Path("/absent").read_text()

    def end() -> None:
        os._exit(0)

    harmful = (allocate, loop, absent, os.abort, end, partial(refuse, ""))
    works = (list, *harmful, partial(refuse, "No."), list)
    found = [verdict.outcome for verdict in outcomes(works, seconds=1)]
    assert found == [
        *("accepted", "memory", "hang", "traceback", "crash", "crash", "message", "refused"),
        "accepted",
    ]
