"""Start-up: naming the package or asking for help loads nothing heavy."""

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
HEAVY = (
    "numpy",
    "jaxtyping",
    "mujoco",
    "pinocchio",
    "sympy",
    "pandas",
    "matplotlib",
    "rerun",
    "pydantic",
    "scipy",
)
HELP = """
import sys
from sysid_bench.commands.main import main
sys.argv = ["sysid-bench", "--help"]
try:
    main()
except SystemExit as end:
    assert end.code in (0, None), end.code
"""
COMMANDS = {
    *("crosscheck", "list", "show", "plan", "run", "status", "cell", "table", "report"),
    *("record", "view", "doctor", "excite", "basis", "identify", "init", "check-plugin"),
}


def python(code: str) -> subprocess.CompletedProcess[str]:
    """Answer of a fresh interpreter in the checkout."""
    return subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, text=True, capture_output=True, timeout=60
    )


def heavy_after(code: str) -> list[str]:
    """The heavy packages that a fresh interpreter holds after running some code."""
    last = f"import json, sys\nprint(json.dumps([m for m in {HEAVY!r} if m in sys.modules]))"
    done = python(f"{code}\n{last}")
    assert done.returncode == 0, done.stderr
    modules: list[str] = json.loads(done.stdout.splitlines()[-1])
    return modules


def test_importing_the_package_loads_nothing_heavy() -> None:
    assert heavy_after("import sysid_bench; assert sysid_bench.__file__") == []


def test_asking_for_help_loads_nothing_heavy() -> None:
    assert heavy_after(HELP) == []


@pytest.mark.parametrize("package", ["scipy", "sympy"])
def test_the_probe_sees_what_is_loaded(package: str) -> None:
    assert package in heavy_after(f"import {package}")


def test_help_names_every_verb() -> None:
    done = python(HELP)
    assert done.returncode == 0, done.stderr
    shown = set(re.findall(r"^\s+([a-z-]+)\s", done.stdout + "\n", re.MULTILINE))
    assert shown >= COMMANDS, f"not in --help: {sorted(COMMANDS - shown)}"


def test_the_package_offers_what_python_users_are_promised() -> None:
    promised = "s.run, s.open_run, s.crosscheck"
    done = python(f"import sysid_bench as s; print(*(callable(f) for f in ({promised})))")
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == ["True"] * 3


@pytest.mark.parametrize("chosen", [None, "3"])
def test_a_command_has_one_blas_thread_unless_its_user_says_more(chosen: str | None) -> None:
    name = "OPENBLAS_NUM_THREADS"
    before = f"os.environ.pop({name!r}, None)" if chosen is None else f"os.environ[{name!r}] = '3'"
    done = python(
        f"import os; {before}\nfrom sysid_bench.commands.main import main\n"
        f"main(['list', 'robots'], standalone_mode=False)\nprint(os.environ[{name!r}])"
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.split()[-1] == (chosen or "1")


RECORDED = """
import sysid_bench
from sysid_bench.commands.identify_recorded import identify_recorded
last = ["scipy.signal", "scipy.ndimage", "scipy.optimize", "pinocchio", "tomlkit"]
print(json.dumps([name for name in last if name in sys.modules]))
"""


def test_identifying_a_recording_loads_one_engine_and_no_signal_toolbox() -> None:
    """These took as long to load as a recording of 10 s to be identified."""
    done = python(f"import json, sys{RECORDED}")
    assert json.loads(done.stdout) == [], done.stderr


def test_listing_figures_draws_none_and_loads_no_engine() -> None:
    """The engines took longer to load than the names of the figures to be found."""
    engines = {"mujoco", "pinocchio", "scipy", "sympy", "matplotlib"}
    assert engines.isdisjoint(heavy_after("import sysid_bench; sysid_bench.figure"))
