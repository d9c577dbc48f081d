"""Where numbers come from: versions, machine, code. Heavy packages are looked at, not imported."""

import hashlib
import importlib.util
import os
import platform
import re
import subprocess
import sys
from collections.abc import Iterable, Mapping
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, Final

from sysid_bench import naming
from sysid_bench.errors import SysidBenchError
from sysid_bench.harness.canonical import digest
from sysid_bench.harness.plan import Cell
from sysid_bench.harness.suite.names import located

PACKAGES: Final = ("sysid-bench", "numpy", "scipy", "mujoco", "pin", "pandas", "clarabel")
"""Distributions whose version can change a number."""

_FLAGS = ("sse4_2", "avx", "avx2", "fma", "avx512f", "asimd", "neon", "sve")
_PACKAGE = Path(__file__).resolve().parents[1]
_INCLUDE = re.compile(rb"""<include\s+file\s*=\s*["']([^"']+)["']""")


def environment() -> dict[str, Any]:
    """Python, platform, CPU, BLAS, versions and git state, as written to env.json."""
    return {
        "python": platform.python_version(),
        "platform": platform.platform(),
        "cpu": _cpu(),
        "cores": os.cpu_count(),
        "instructions": _instructions(),
        "blas": _blas(),
        "versions": versions(),
        "git": _git(),
    }


@cache
def _versions() -> tuple[tuple[str, str | None], ...]:
    return tuple((name, _version(name)) for name in PACKAGES)


def versions() -> dict[str, str | None]:
    """Installed versions of `PACKAGES`; None where a package is absent."""
    return dict(_versions())


def fingerprint(paths: Iterable[Path], plugins: Iterable[str]) -> str:
    """16 hex digits over this package's source, the bytes of model files (with the files that an
    MJCF includes) and of motions, the files of plug-ins ("module:object", "file:x.py:object") and
    versions.

    A plug-in stands for the whole package that it lies in. Files are read once per process.
    """
    models = tuple(sorted(str(Path(path).resolve()) for path in paths))
    return _fingerprint(models, tuple(sorted(set(plugins))))


def cell_fingerprint(cell: Cell, robots_dir: Path | None, folder: Path | None) -> str:
    """The fingerprint of everything that a cell's row depends on; "" where its robot is gone."""
    spec = cell.spec
    plugins = {
        "plant": [spec.plant],
        "excitation": [spec.excitation, *spec.held_out],
        "simulation": [spec.simulation],
        "estimator": [cell.estimator],
    }
    files = _model_files(spec.robot, robots_dir, folder)
    if not files:
        return ""
    targets = [_target(kind, plugin, folder) for kind, some in plugins.items() for plugin in some]
    specs = [located(plugin, folder) for some in plugins.values() for plugin in some]
    read = [Path(spec["file"]) for spec in specs if isinstance(spec.get("file"), str)]
    if spec.log is not None:
        from sysid_bench.harness.experiment.recorded.cells import log_files

        own = _target("estimator", cell.estimator, folder)
        return fingerprint([*files, *log_files(spec.log, folder or Path())], [own])
    return fingerprint([*files, *read], targets)


@cache
def _model_files(robot: str, robots_dir: Path | None, folder: Path | None) -> tuple[Path, ...]:
    from sysid_bench.models.manifest import find_manifest

    try:
        manifest = find_manifest(robot, robots_dir, folder)
    except SysidBenchError:
        return ()
    return tuple(path for path in (manifest.path, manifest.manifest_file) if path is not None)


def _target(kind: str, plugin: Mapping[str, Any], folder: Path | None) -> str:
    use = str(located(plugin, folder)["use"])
    return use if ":" in use else naming.known(kind).get(use, use)


@cache
def code_and_libraries() -> str:
    """A hash of this package's code and of the versions it runs with."""
    return digest([_tree(str(_PACKAGE)), versions(), sys.version_info[:2]])[:16]


@cache
def _fingerprint(models: tuple[str, ...], plugins: tuple[str, ...]) -> str:
    parts = [
        _tree(str(_PACKAGE)),
        [_model(path) for path in models],
        [_plugin(name) for name in plugins],
        versions(),
        sys.version_info[:2],
    ]
    return digest(parts)[:16]


@cache
def _tree(folder: str) -> str:
    """Hash of all Python files below a folder, with their places."""
    found = hashlib.sha256()
    for file in sorted([*Path(folder).rglob("*.py"), *Path(folder).rglob("*.c")]):
        found.update(f"{file.relative_to(folder)}\0".encode() + file.read_bytes() + b"\0")
    return found.hexdigest()


@cache
def _file(path: str) -> str:
    try:
        return hashlib.sha256(Path(path).read_bytes()).hexdigest()
    except OSError:
        return "absent"


@cache
def _model(path: str) -> list[str]:
    """Hashes of a model file and of what it includes."""
    met, waiting = {}, [Path(path)]
    while waiting:
        file = waiting.pop()
        if str(file) in met:
            continue
        met[str(file)] = _file(str(file))
        if met[str(file)] != "absent":
            names = _INCLUDE.findall(file.read_bytes())
            waiting += [file.parent / name.decode(errors="replace") for name in names]
    return list(met.values())


@cache
def _plugin(name: str) -> str:
    place = name.rpartition(":")[0] or name
    if place.startswith("file:"):
        return _file(place.removeprefix("file:"))
    root = place.partition(".")[0]
    if root == _PACKAGE.name:
        return ""  # its tree is in every fingerprint
    try:
        spec = importlib.util.find_spec(root)
    except (ImportError, ValueError):
        spec = None
    if spec is None:
        return "absent"
    if spec.submodule_search_locations:
        return digest([_tree(folder) for folder in spec.submodule_search_locations])
    return _file(spec.origin) if spec.origin else "absent"


def _version(name: str) -> str | None:
    try:
        return version(name)
    except PackageNotFoundError:
        return None


def _cpu() -> str:
    models = re.findall(r"^model name\s*:\s*(.+)$", _cpuinfo(), re.MULTILINE)
    return models[0].strip() if models else platform.processor() or platform.machine()


def _instructions() -> list[str]:
    lines = re.findall(r"^(?:flags|Features)\s*:\s*(.+)$", _cpuinfo(), re.MULTILINE)
    there = set(lines[0].split()) if lines else set()
    return [flag for flag in _FLAGS if flag in there]


def _cpuinfo() -> str:
    try:
        return Path("/proc/cpuinfo").read_text(errors="replace")
    except OSError:
        return ""


def _blas() -> str:
    import numpy as np

    config: Any = np.show_config(mode="dicts")
    found = config.get("Build Dependencies", {}).get("blas", {})
    return f"{found.get('name', 'unknown')} {found.get('version', '')}".strip()


def _git() -> dict[str, Any] | None:
    """Commit and dirtiness of the checkout that this package lies in; None where it is none."""
    checkout = _PACKAGE.parent
    if not (checkout / ".git").exists():
        return None
    commit, state = _ask_git(checkout, "rev-parse", "HEAD"), _ask_git(checkout, "status", "-s")
    return {"commit": commit, "dirty": None if state is None else bool(state)}


def _ask_git(checkout: Path, *words: str) -> str | None:
    try:
        done = subprocess.run(
            ["git", "-C", str(checkout), *words], capture_output=True, text=True, timeout=10
        )
    except (OSError, subprocess.TimeoutExpired):
        return None
    return done.stdout.strip() if done.returncode == 0 else None
