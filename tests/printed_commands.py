"""Commands and files of a page, as printed, in a folder.

`sysid-bench` runs within this process: loading the libraries takes longer than most commands.
Workers are processes all the same; what else a shell does is left to one.
"""

import os
import re
import shlex
import subprocess
import sys
from contextlib import chdir
from pathlib import Path

from click.testing import CliRunner

from sysid_bench.commands.main import main

ROOT = Path(__file__).parents[1]
BLOCK = re.compile(r"^```(\w+)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
FILE = re.compile(r"^(?:#|<!--) file: (\S+)(?: -->)?\n")
PROGRAM = "sysid-bench"
_SHELL = re.compile(r"[|&;<>$`*?(){}]")


def blocks(text: str) -> list[tuple[str, str]]:
    """(language, text) of every fenced block of a page."""
    return BLOCK.findall(text)


def place(folder: Path, block: str) -> bool:
    """Write a block that is a file; return whether it is one."""
    named = FILE.match(block)
    if named:
        file = folder / named[1]
        file.parent.mkdir(parents=True, exist_ok=True)
        # A comment before an XML document stands on no line of its own in the file.
        text = block if block.startswith("#") else block[named.end() :]
        file.write_text(text, encoding="utf-8")
    return named is not None


def run_line(line: str, folder: Path) -> subprocess.CompletedProcess[str]:
    """Run a line of a shell block in the folder."""
    words = shlex.split(line, comments=True)
    if words[0] == PROGRAM and not _is_shell(line):
        return _run_here(words, folder)
    return subprocess.run(
        ["sh", "-c", line], cwd=folder, env=_environment(folder), text=True, capture_output=True,
        timeout=600, check=False,
    )  # fmt: skip


def run_python(text: str, folder: Path) -> subprocess.CompletedProcess[str]:
    """Run a block of Python in the folder, in a process of its own."""
    return subprocess.run(
        [sys.executable, "-c", text], cwd=folder, env=_environment(folder), text=True,
        capture_output=True, timeout=600, check=False,
    )  # fmt: skip


def _is_shell(line: str) -> bool:
    """True for words that a shell would change: special characters outside of quotes."""
    return bool(_SHELL.search(re.sub(r"'[^']*'|\"[^\"$`]*\"|\s#.*", "", line)))


def _run_here(words: list[str], folder: Path) -> subprocess.CompletedProcess[str]:
    path = list(sys.path)
    try:
        with chdir(folder):
            done = CliRunner(catch_exceptions=False).invoke(main, words[1:], prog_name=PROGRAM)
    finally:
        sys.path[:] = path
    return subprocess.CompletedProcess(words, done.exit_code, done.stdout, done.stderr)


def _environment(folder: Path) -> dict[str, str]:
    """`sysid-bench` and `python` of this interpreter on the path."""
    scripts = folder / ".bin"
    if not scripts.is_dir():
        scripts.mkdir()
        for name, arguments in ((PROGRAM, "-m sysid_bench "), ("python", "")):
            script = scripts / name
            script.write_text(f'#!/bin/sh\nexec "{sys.executable}" {arguments}"$@"\n')
            script.chmod(0o755)
    path = f"{scripts}{os.pathsep}{os.environ['PATH']}"
    return {**os.environ, "PATH": path, "PYTHONPATH": str(ROOT)}
