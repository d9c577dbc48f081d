"""Completion: every value that has names is completed, in bash itself, and quickly."""

import json
import os
import resource
import shutil
import subprocess
import sys
from pathlib import Path

import click
import pytest
from sysid_bench.completion.answer import candidates, completed_text, line_words
from sysid_bench.completion.known_words import FREE, known_words
from sysid_bench.completion.start_files import SCRIPTS
from sysid_bench.completion.stored_words import cache_folder, stored_words
from sysid_bench.completion.values import CHANGING

from sysid_bench import package_folders, plugin_names
from sysid_bench.commands.catalogue import KINDS
from sysid_bench.commands.main import main
from sysid_bench.metrics import METRICS
from sysid_bench.reference.command_page import commands
from sysid_bench.reference.pages import title_by_page

from .conftest import Run

ROOT = Path(__file__).parents[2]
QUICK = 0.3  # CPU seconds
IDS = ("0a1b2c3d4e5f", "0a9b2c3d4e5f", "ff1b2c3d4e5f")


@pytest.fixture(scope="module")
def words() -> dict[str, object]:
    """The words of this checkout."""
    return known_words()


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The working folder, with a run, a log and names of one's own."""
    run = tmp_path / "reports" / "mine"
    (run / "tables").mkdir(parents=True)
    lines = (json.dumps({"id": name, "experiment": "e"}) for name in IDS)
    (run / "plan.jsonl").write_text("\n".join(lines) + "\n")
    (run / "tables" / "main.md").write_text("")
    (tmp_path / "robots" / "my_arm").mkdir(parents=True)
    (tmp_path / "robots" / "my_arm" / "robot.toml").write_text("")
    (tmp_path / "my log.toml").write_text("")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return tmp_path


def goes_on(words: dict[str, object], line: str) -> list[str]:
    """What a line goes on with."""
    before, word, _ = line_words(line)
    return list(dict(candidates(words, before[1:], word)))


def test_every_option_and_argument_has_values_or_is_free() -> None:
    tree, free = known_words()["verb"], set(FREE)
    for name, command in commands(main):
        verb = tree
        for word in name.split():
            verb = verb["verbs"][word]
        arguments = iter(verb["arguments"])
        for param in command.params:
            is_option = isinstance(param, click.Option)
            known = verb["options"][param.opts[0]] if is_option else next(arguments)
            is_number = isinstance(param.type, (click.types.IntParamType, click.types.FloatRange))
            if known["takes_value"] and not is_number:
                served = bool(known["kinds"] or known["choices"])
                assert served or param.name in FREE, f"{name} {param.name}"
                free -= set() if served else {param.name}
    assert not free, "no option has these names any more"


def test_every_kind_has_values(words: dict[str, dict[str, object]]) -> None:
    kinds = {kind for one in _params(words["verb"]) for kind in one["kinds"]}
    assert len(kinds) > 20
    assert kinds <= {*words["words"], *CHANGING}
    assert all(words["words"][kind] for kind in kinds - {*CHANGING})


def _params(verb: dict) -> list[dict]:  # type: ignore[type-arg]
    inner = [param for one in verb["verbs"].values() for param in _params(one)]
    return [*verb["arguments"], *verb["options"].values(), *inner]


def test_values_are_those_of_the_registries(words: dict[str, object], place: Path) -> None:
    def after(line: str) -> set[str]:
        return set(goes_on(words, f"sysid-bench {line} "))

    assert after("identify --estimator") == set(plugin_names.known("estimator"))
    assert after("identify --task") == set(plugin_names.known("task"))
    assert after("compare --metrics") == set(METRICS)
    assert after("list") == set(KINDS)
    assert after("help") >= set(title_by_page()) | {"ols", "viscous"}
    assert after("plan") >= set(package_folders.suite_files())
    assert after("crosscheck ur5") >= {*package_folders.robots(), "my_arm", "my log.toml"}
    assert after("fetch") >= set(package_folders.dataset_files())
    assert after("show") >= set(package_folders.plant_files())
    assert after("status") == {"reports/mine", "reports/", "robots/"}
    assert after("cell reports/mine") == set(IDS)
    assert after("table reports/mine") == {"main"}
    assert after("run smoke --rerun") == {"failed", "stale", "all"}
    assert after("baseline") == {"save", "update"}
    assert "reports/mine" in after("run")


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("identify --est", ["--estimator"]),
        ("identify --estimator=lmi-p", ["--estimator=lmi-pullback"]),
        ("compare a b --metrics rank,torque_error_w", [
            "rank,torque_error_weighted", "rank,torque_error_worst"]),
        ("cell reports/mine 0a1", [IDS[0]]),
        ("identify --log my", ["my log.toml"]),
        ("identify --log 'my l", ["my log.toml"]),
        ("plan smoke --robots rob", ["robots/"]),
        ("plan smoke --select x", []),
        ("show dvrk_p", ["dvrk_psm"]),
    ],
)  # fmt: skip
def test_a_line_goes_on(
    words: dict[str, object], place: Path, line: str, expected: list[str]
) -> None:
    assert goes_on(words, f"sysid-bench {line}") == expected


def test_bash_replaces_what_follows_its_breaks() -> None:
    assert completed_text(["--task=link"], "--task=li", "") == "link"
    assert completed_text(["dask://"], "da", "") == "dask://"
    assert completed_text(["my log.toml"], "my", "") == r"my\ log.toml"
    assert completed_text(["my log.toml"], "my", "'") == "my log.toml"
    assert completed_text(["--of=a b", "--of=c"], "--of=", "") == "a\\ b\nc"


IN_BASH = [
    ("", "crosscheck"), ("identify my", "my_arm"), ("plan smo", "smoke"),
    ("identify --estimator hub", "huber"), ("identify --task pay", "payload"),
    ("identify --payload box", "box-2kg"), ("compare a b --metrics rank_g", "rank_gap"),
    ("show lug", "lugre"), ("fetch dvrk_p", "dvrk_psm"), ("report reports/m", "reports/mine"),
    ("cell reports/mine ff", IDS[2]), ("table reports/mine ma", "main"),
    ("help met", "metrics"), ("list exec", "executors"),
    ("basis --terms viscous,co", "viscous,coulomb"),
]  # fmt: skip


@pytest.mark.skipif(shutil.which("bash") is None, reason="bash is not installed")
def test_bash_completes_every_kind_of_value_quickly(place: Path) -> None:
    """CPU seconds of bash and of what it starts, the least of three: other work is not counted."""
    program = place / "sysid-bench"
    program.write_text(f'#!/bin/sh\nexec {sys.executable} -m sysid_bench "$@"\n')
    program.chmod(0o755)
    (place / "script").write_text(SCRIPTS["bash"])
    stored_words()
    for line, expected in IN_BASH:
        seconds: list[float] = []
        while not seconds or (seconds[-1] >= QUICK and len(seconds) < 3):
            before = _cpu_seconds()
            found = _in_bash(program, f"sysid-bench {line}")
            seconds.append(_cpu_seconds() - before)
            assert expected in found, line
        assert min(seconds) < QUICK, line


def _in_bash(program: Path, line: str) -> list[str]:
    """What bash would insert."""
    commands_ = (
        'source script; COMP_LINE="$1"; COMP_POINT=${#1}; COMP_WORDS=($1); compopt() { :; };'
        ' _sysid_bench; printf "%s\\n" "${COMPREPLY[@]}"'
    )
    paths = f"{program.parent}{os.pathsep}{os.environ['PATH']}"
    done = subprocess.run(
        ["bash", "--norc", "-c", commands_, "bash", line],
        env={**os.environ, "PATH": paths, "PYTHONPATH": str(ROOT)},
        text=True, capture_output=True, timeout=60,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()


def _cpu_seconds() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def test_an_answer_loads_neither_the_parser_nor_a_library(place: Path) -> None:
    stored_words()
    code = (
        "import sys; sys.argv[1:] = ['complete', 'bash', 'sysid-bench identify --estimator o']\n"
        "from sysid_bench.__main__ import start\nstart()\n"
        "print([name for name in ('click', 'numpy', 'pydantic') if name in sys.modules])"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, text=True, capture_output=True, timeout=60
    )
    assert done.stdout.splitlines() == ["ols", "[]"], done.stderr


def test_stored_words_are_made_again_where_they_are_broken(place: Path) -> None:
    first = stored_words()
    [file] = Path(cache_folder()).iterdir()
    file.write_text("{")
    assert stored_words() == first
    assert json.loads(file.read_text()) == first


def test_completion_is_switched_on_once(
    cli: Run, place: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HOME", str(place))
    monkeypatch.setenv("SHELL", "/usr/bin/zsh")
    (place / ".zshrc").write_text("alias a=b")
    assert cli("completion", "--install").returncode == 0
    line = 'eval "$(sysid-bench completion zsh)"'
    assert (place / ".zshrc").read_text().splitlines() == ["alias a=b", line]
    assert cli("completion", "--install").returncode == 2
    assert cli("completion", "fish").stdout.strip() == SCRIPTS["fish"].strip()
    assert "'bash'" in cli("completion", "bahs").stderr
