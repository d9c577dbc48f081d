"""Completion: every value that has names is completed, in bash itself, and quickly."""

import json
import os
import resource
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import click
import pytest
from click.shell_completion import BashComplete

from sysid_bench import package_folders, plugin_names
from sysid_bench.commands.catalogue import KINDS
from sysid_bench.commands.completion import CHANGING, VARIABLE, names_of, script, words_by_kind
from sysid_bench.commands.main import main
from sysid_bench.commands.stored import cache_folder
from sysid_bench.metrics import METRICS
from sysid_bench.reference.pages import commands, title_by_page

from .conftest import Run

ROOT = Path(__file__).parents[2]
QUICK = 0.3  # CPU seconds
IDS = ("0a1b2c3d4e5f", "0a9b2c3d4e5f", "ff1b2c3d4e5f")
FREE = frozenset((
    "also", "at", "base", "boxes", "clamp", "contacts", "export", "family", "gains",
    "joints", "limits", "margin", "massless", "motor_types", "name", "noise", "objective", "others",
    "overrides", "period", "rate", "sensor", "shard", "share", "timeout",
))  # fmt: skip
"""Options whose values are the user's own."""


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


def goes_on(line: str) -> dict[str, str]:
    """What a line after the program's name goes on with: types of values, by the value."""
    words = shlex.split(line)
    begun = "" if line[-1:].isspace() else words.pop()
    found = BashComplete(main, {}, "sysid-bench", VARIABLE).get_completions(words, begun)
    return {item.value: item.type for item in found}


def _is_served(param: click.Parameter) -> bool:
    """True where values of an option or argument are completed, or need not be."""
    is_flag = isinstance(param, click.Option) and (param.is_flag or param.count)
    is_number = isinstance(param.type, (click.types.IntParamType, click.types.FloatParamType))
    has_values = param._custom_shell_complete is not None or hasattr(param.type, "choices")
    return is_flag or is_number or has_values or isinstance(param.type, click.Path)


def test_every_option_and_argument_has_values_or_is_free() -> None:
    free = set(FREE)
    for name, command in commands(main):
        for param in command.params:
            served = _is_served(param)
            assert served or param.name in FREE, f"{name} {param.name}"
            free -= set() if served else {str(param.name)}
    assert not free, "no option has these names any more"


def test_every_kind_has_values() -> None:
    words = words_by_kind()
    assert len(words) > 20
    assert all(words[kind] for kind in words)
    assert "plants" in {*words} & {*CHANGING}
    with pytest.raises(KeyError, match="robot"):
        names_of("robot", "", ())


def test_values_are_those_of_the_registries(place: Path) -> None:
    def after(line: str) -> set[str]:
        return set(goes_on(f"{line} ")) - {""}

    assert after("identify --estimator") == set(plugin_names.known("estimator"))
    assert after("identify --task") == set(plugin_names.known("task"))
    assert after("compare --metrics") == set(METRICS)
    assert after("list") == set(KINDS)
    assert after("help") >= set(title_by_page()) | {"ols", "viscous"}
    assert after("plan") >= set(package_folders.suite_files())
    assert after("crosscheck ur5") >= {*package_folders.robots(), "my_arm"}
    assert after("fetch") >= set(package_folders.dataset_files())
    assert after("show") >= set(package_folders.plant_files())
    assert after("status") == {"reports/mine"}
    assert after("cell reports/mine") == set(IDS)
    assert after("table reports/mine") == {"main"}
    assert after("run smoke --rerun") == {"failed", "stale", "all"}
    assert after("baseline") == {"save", "update"}
    assert "reports/mine" in after("run")


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("identify --est", ["--estimator"]),
        ("identify --estimator=lmi-p", ["lmi-pullback"]),
        ("compare a b --metrics rank,torque_error_w", [
            "rank,torque_error_weighted", "rank,torque_error_worst"]),
        ("cell reports/mine 0a1", [IDS[0]]),
        ("plan smoke --select x", []),
        ("show dvrk_p", ["dvrk_psm"]),
    ],
)  # fmt: skip
def test_a_line_goes_on(place: Path, line: str, expected: list[str]) -> None:
    assert list(goes_on(line)) == expected


@pytest.mark.parametrize(
    ("line", "kind"),
    [("identify --log my", "file"), ("crosscheck my", "file"), ("plan smoke --robots rob", "dir")],
)
def test_files_and_folders_are_completed_by_the_shell(place: Path, line: str, kind: str) -> None:
    assert goes_on(line)[line.rpartition(" ")[2]] == kind


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
    (place / "script").write_text(script("bash"))
    for line, expected in [IN_BASH[3], *IN_BASH]:  # the first answer fills the cache
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
        'source script; COMP_WORDS=($1); case "$1" in *" ") COMP_WORDS+=("");; esac;'
        " COMP_CWORD=$((${#COMP_WORDS[@]} - 1)); compopt() { :; };"
        ' _sysid_bench_completion sysid-bench; printf "%s\\n" "${COMPREPLY[@]}"'
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


def test_an_answer_loads_no_library(place: Path) -> None:
    names_of("names", "", ())
    code = (
        "import os, sys\n"
        f"os.environ |= {{{VARIABLE!r}: 'bash_complete', 'COMP_CWORD': '3',\n"
        "    'COMP_WORDS': 'sysid-bench identify --estimator o'}\n"
        "from sysid_bench.__main__ import start\n"
        "try:\n    start()\nexcept SystemExit:\n    pass\n"
        "print([name for name in ('numpy', 'pydantic') if name in sys.modules])"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, text=True, capture_output=True, timeout=60
    )
    assert done.stdout.splitlines() == ["plain,ols", "[]"], done.stderr


def test_stored_words_are_made_again_where_they_are_broken(place: Path) -> None:
    first = names_of("names", "", ())
    [file] = Path(cache_folder()).glob("words-*")
    file.write_text("{")
    assert names_of("names", "", ()) == first
    assert json.loads(file.read_text())["names"] == first


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
    assert cli("completion", "fish").stdout.strip() == script("fish").strip()
    assert "'bash'" in cli("completion", "bahs").stderr
