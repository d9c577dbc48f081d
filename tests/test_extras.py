"""Extras: each package that is needed by a part alone belongs to one, and is named where absent."""

import importlib.util
import pkgutil
import subprocess
import sys
import tomllib
import types
from pathlib import Path

import pytest

import sysid_bench
from sysid_bench.errors import UsageError
from sysid_bench.extras import EXTRAS, extra_module, missing

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]


@pytest.mark.parametrize("package", EXTRAS)
def test_each_package_has_an_extra_that_is_there(package: str) -> None:
    assert EXTRAS[package] in PROJECT["optional-dependencies"]
    assert f"pip install 'sysid-bench[{EXTRAS[package]}]'" in str(missing(package, "This"))


def test_an_absent_package_is_one_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "rerun", None)
    with pytest.raises(UsageError, match=r"A recording needs rerun.*sysid-bench\[rerun\]'"):
        extra_module("rerun", "A recording")
    monkeypatch.setitem(sys.modules, "rerun", types.ModuleType("rerun"))
    monkeypatch.setitem(sys.modules, "rerun.chunk", None)
    monkeypatch.setattr("sysid_bench.extras.find_spec", lambda package: package == "rerun")
    with pytest.raises(UsageError, match=r"rerun\.chunk.* --upgrade rerun-sdk\.$"):
        extra_module("rerun.chunk", "A recording")
    assert extra_module("json", "This").dumps({}) == "{}"


def test_the_extra_all_holds_every_extra_that_users_need() -> None:
    (whole,) = PROJECT["optional-dependencies"]["all"]
    inside = set(whole.partition("[")[2].rstrip("]").split(","))
    assert set(EXTRAS.values()) <= inside
    assert inside - {"docs"} <= set(EXTRAS.values())


ABSENT = """
import importlib, pkgutil, signal, sys, os
for name in {names!r}:
    sys.modules[name] = None
for name in ("fork", "setsid", "getuid", "nice", "killpg", "getpgid"):
    if hasattr(os, name):
        delattr(os, name)
signals = ("SIGKILL", "SIGCHLD", "SIGHUP", "SIGALRM", "pthread_sigmask", "SIG_BLOCK")
for name in signals:
    if hasattr(signal, name):
        delattr(signal, name)
import sysid_bench
failed = []
for module in pkgutil.walk_packages(sysid_bench.__path__, "sysid_bench."):
    compiled = module.name.rpartition(".")[2].startswith("lib")
    if compiled or module.name.endswith(("__main__", "pytest_cells", "pytest_suite")):
        continue
    try:
        importlib.import_module(module.name)
    except Exception as error:
        failed.append(f"{{module.name}}: {{error}}")
print("\\n".join(failed))
"""

NEEDED = {  # modules that are loaded with what needs the package, and not before
    "pinocchio": ("models.pairing", "regressors.pinocchio"),
    "rerun": ("reporting.recording", "reporting.scene"),
    "sympy": ("regressors.symbolic_regressor",),
}


def failures(*names: str) -> list[str]:
    done = subprocess.run(
        [sys.executable, "-c", ABSENT.format(names=names)],
        cwd=ROOT, text=True, capture_output=True, timeout=120, check=True,
    )  # fmt: skip
    return [line for line in done.stdout.splitlines() if line]


def test_every_module_loads_without_posix_and_without_extras() -> None:
    posix = ("fcntl", "resource", "pwd", "grp", "termios", "tty")
    extras = ("pinocchio", "rerun", "pyarrow", "rosbags", "h5py", "distributed", "sympy")
    heads = tuple(f"sysid_bench.{name}" for names in NEEDED.values() for name in names)
    wrong = [line for line in failures(*posix, *extras) if not line.startswith(heads)]
    assert not wrong, "\n".join(wrong)


def test_the_check_sees_a_module_that_needs_what_is_absent() -> None:
    assert any(line.startswith("sysid_bench.simulation") for line in failures("mujoco"))
    assert importlib.util.find_spec("sysid_bench.simulation") is not None
    assert len(list(pkgutil.iter_modules(sysid_bench.__path__))) > 10
