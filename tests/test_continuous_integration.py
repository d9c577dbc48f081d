"""The repository of docs/continuous-integration.md: green, then red after a change of the robot."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
TEXT = (ROOT / "docs" / "continuous-integration.md").read_text(encoding="utf-8")
BLOCK = re.compile(r"```(\w+)\n(.*?)```", re.DOTALL)
FILE = re.compile(r"# file: (\S+)\n")


def execute(line: str, folder: Path) -> subprocess.CompletedProcess[str]:
    words = line.replace("sysid-bench", f"{sys.executable} -m sysid_bench", 1)
    return subprocess.run(
        ["sh", "-c", words], cwd=folder, env={**os.environ, "PYTHONPATH": str(ROOT)},
        text=True, capture_output=True, timeout=300,
    )  # fmt: skip


@pytest.mark.long
def test_the_repository_is_green_then_red(tmp_path: Path) -> None:
    blocks = BLOCK.findall(TEXT)
    for _, text in blocks:
        if named := FILE.match(text):
            (tmp_path / named[1]).parent.mkdir(parents=True, exist_ok=True)
            (tmp_path / named[1]).write_text(text, encoding="utf-8")
    once = [line for kind, text in blocks if kind == "sh" for line in text.splitlines()]
    steps = re.findall(r"- run: (sysid-bench .*)", TEXT)
    assert len(once) == len(steps) == 3
    for line in (*once, *steps):
        done = execute(line, tmp_path)
        assert done.returncode == 0, done.stdout + done.stderr
    method = tmp_path / "methods" / "truncated.py"
    method.write_text(method.read_text().replace("share: float = 1e-10", "share: float = 0.3"))
    runs = [execute(line.replace("runs/ci", "runs/changed"), tmp_path) for line in steps]
    assert runs[-1].returncode == 1
    assert "torque_error" in runs[-1].stdout
    assert "Truncated" in runs[-1].stdout
    assert "::error file=regression.json" in runs[-1].stdout
    assert (tmp_path / "regression.xml").is_file()
