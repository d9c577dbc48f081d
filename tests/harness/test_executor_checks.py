"""The conformance kit of executors accepts that of this machine, and finds what others break."""

import shutil
from collections.abc import Callable
from dataclasses import replace

import pytest

import sysid_bench
from sysid_bench.apps.conformance.executor_checks import check_executor
from sysid_bench.errors import UsageError
from sysid_bench.harness.executor import Local, RunEnd, Work
from sysid_bench.harness.work.row_files import row_files
from sysid_bench.harness.work.supervise import OnEvent, no_progress

ROWS = "each cell has one row, as on one machine"
ENDS = "limits are hard, and an end costs its own cell"
RESUMES = "an interrupted run resumes"
REPORTS = "reports each row"
STOPS = "stops at the first failure when asked"

Act = Callable[[Work, OnEvent], RunEnd]


def loses_a_job(work: Work, on_event: OnEvent) -> RunEnd:
    return Local().work(replace(work, jobs=work.jobs[1:]), on_event)


def writes_twice(work: Work, on_event: OnEvent) -> RunEnd:
    ended = Local().work(work, on_event)
    for file in row_files(work.settings.folder / "cells"):
        shutil.copy(file, file.with_name(f"9-{file.name}"))
    return ended


def invents_an_ending(work: Work, on_event: OnEvent) -> RunEnd:
    ended = Local().work(work, on_event)
    for file in row_files(work.settings.folder / "cells"):
        file.write_text(file.read_text().replace('"timeout"', '"lost"'))
    return ended


def is_interrupted(work: Work, on_event: OnEvent) -> RunEnd:
    def hear(kind: str, data: object) -> None:
        if kind == "row":
            raise KeyboardInterrupt

    Local().work(work, no_progress)
    hear("row", None) if work.jobs and len(work.jobs) == 6 else None
    return RunEnd("finished")


def is_silent(work: Work, on_event: OnEvent) -> RunEnd:
    return Local().work(work, no_progress)


def goes_on(work: Work, on_event: OnEvent) -> RunEnd:
    return Local().work(replace(work, fail_fast=False), on_event)


class Executor:
    def __init__(self, act: Act) -> None:
        self.act = act

    def work(self, work: Work, on_event: OnEvent) -> RunEnd:
        return self.act(work, on_event)


def violated(act: Act) -> set[str]:
    return {f.law for f in check_executor(Executor(act)) if not f.passed}


@pytest.mark.long
@pytest.mark.parametrize(
    ("act", "laws"),
    [
        (loses_a_job, {ROWS, ENDS, RESUMES, STOPS}),
        (writes_twice, {ROWS, ENDS, RESUMES, REPORTS}),
        (invents_an_ending, {ENDS}),
        (is_interrupted, {RESUMES, REPORTS, STOPS}),
        (is_silent, {REPORTS}),
        (goes_on, {STOPS}),
    ],
)
def test_a_broken_promise_is_named(act: Act, laws: set[str]) -> None:
    assert violated(act) == laws


@pytest.mark.long
def test_processes_of_this_machine_keep_all_laws() -> None:
    result = sysid_bench.check_plugin("local", kind="executor")
    assert result.ok, result.summary()
    assert result.checks == 5


@pytest.mark.parametrize("name", ["lokal", "slurm:nowhere.toml"])
def test_an_executor_that_cannot_compute_is_one_sentence(name: str) -> None:
    with pytest.raises(UsageError) as caught:
        sysid_bench.check_plugin(name, kind="executor")
    assert "\n" not in str(caught.value)
