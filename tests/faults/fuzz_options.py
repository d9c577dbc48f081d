"""Kinds of input that a shell gives: the words of a command, and variables of the environment."""

import os
import re
from collections.abc import Callable
from pathlib import Path
from typing import Final
from unittest.mock import patch

from sysid_bench.commands.main import main
from sysid_bench.errors import UsageError
from sysid_bench.experiments.simulated.commanded import design_motion  # noqa: F401 - imported once
from tests.faults import fuzz_seeds as seeds
from tests.faults.fuzz_kind import Kind, make_log, sound_robots, text_files

_LOG: Final = seeds.LOG.replace('"log.csv"', '"$SYSID_BENCH_DATA/log.csv"')


def word(folder: Path) -> str:
    """The damaged text; half of the bytes that are no text stay, as the shell passes them."""
    return (folder / "text").read_bytes().decode("utf-8", errors="surrogateescape")


def _options(folder: Path) -> None:
    """Words of a command, one a line, as a shell passes them: without NUL."""
    os.chdir(folder)
    command(re.sub("\0", "", word(folder)).split("\n"))


def command(words: list[str]) -> None:
    """Take a command; exit code 2 is a refusal, 1, 3 and 4 are answers."""
    try:
        main(args=words, standalone_mode=True)
    except SystemExit as error:
        if error.code == 2:
            raise UsageError("exit code 2") from error
        if error.code not in (0, 1, 3, 4):
            raise


def _make_options(words: str) -> Callable[[Path], None]:
    files = {"text": words.replace(" ", "\n").replace("~", " "), "dh.csv": seeds.DH}
    return text_files(files | {"values.json": seeds.VALUES, "suite.toml": seeds.SUITE})


def _options_kind(verb: str, words: str) -> Kind:
    return Kind(f"options-{verb}", _make_options(f"{verb} {words}"), ("text",), _options, False)


def _make_environment(folder: Path) -> None:
    (folder / "data").mkdir()
    make_log(folder / "data")
    text_files({"text": seeds.ENVIRONMENT, "log.toml": _LOG})(folder)


def _environment(folder: Path) -> None:
    """Lines NAME=VALUE that the environment may hold, then verbs that read it."""
    os.chdir(folder)
    lines = (line.partition("=") for line in re.sub("\0", "", word(folder)).split("\n"))
    found = {name: value for name, equals, value in lines if name and equals}
    with patch.dict(os.environ, found), sound_robots():
        for words in (
            "list robots",
            "basis scara --task robot",
            "identify scara --log log.toml --task robot --accept delay",
            "doctor --json",
        ):
            command(words.split())


OPTIONS: Final = (
    _options_kind("basis", "scara --terms viscous,spin.k --task robot"),
    _options_kind("plan", "suite.toml --set run.repeats=2 --set defaults.rate='100~Hz' "
                  "--select estimator=='ols' --no-code --json"),
    _options_kind("init", "robot --dh dh.csv -o made --base 0,1,0"),
    _options_kind("identify", "scara --simulate --noise tau=1~% --payload point-1kg --task link"),
    _options_kind("excite", "scara --period 2 --harmonics 2 --iterations 2 --starts 1 "
                  "--limit v=1,1,1,1 --objective D=1,cond=0.2"),
    _options_kind("crosscheck", "scara --robots . --json"),
    _options_kind("list", "log-readers --robots . --json"),
    _options_kind("show", "scara --json"),
    Kind("environment", _make_environment, ("text",), _environment, places=False),
)  # fmt: skip
