"""Versions of this package, of its libraries and of the machine.

Versions are read from the metadata of the installation, without imports.
"""

import hashlib
import json
import os
import platform
import re
import subprocess
import sys
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, Final

from sysid_bench.canonical_json import canonical_hash

PACKAGES: Final = ("sysid-bench", "numpy", "scipy", "mujoco", "pin", "pandas", "clarabel")
"""Distributions on whose version results depend."""

_FLAGS = ("sse4_2", "avx", "avx2", "fma", "avx512f", "asimd", "neon", "sve")
_COMMIT: Final = "commit.json"
PACKAGE_FOLDER: Final = Path(__file__).resolve().parent


def environment() -> dict[str, Any]:
    """Return Python, platform, CPU, BLAS, versions and git state, as written to env.json."""
    return {
        "python": platform.python_version(),
        "platform": platform.platform(),
        "cpu": _cpu(),
        "cores": os.cpu_count(),
        "instructions": _instructions(),
        "blas": _blas(),
        "versions": version_fields(),
        "git": _git(),
    }


@cache
def _versions() -> tuple[tuple[str, str | None], ...]:
    return tuple((name, _version(name)) for name in PACKAGES)


def version_fields() -> dict[str, str | None]:
    """Return the installed versions of `PACKAGES`; None where a package is absent."""
    return dict(_versions())


@cache
def package_hash() -> str:
    """Return 16 hex digits of this package's code and of the versions of its libraries."""
    return canonical_hash(
        [source_hash(str(PACKAGE_FOLDER)), version_fields(), sys.version_info[:2]]
    )[:16]


@cache
def source_hash(folder: str) -> str:
    """Return a hash of all Python and C files below a folder, with their paths."""
    found = hashlib.sha256()
    for file in sorted(x for kind in ("py", "c", "h") for x in Path(folder).rglob(f"*.{kind}")):
        # Zero bytes between: text that moves from one file to the next is a change.
        found.update(f"{file.relative_to(folder)}\0".encode() + file.read_bytes() + b"\0")
    return found.hexdigest()


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
    flags = set(lines[0].split()) if lines else set()
    return [flag for flag in _FLAGS if flag in flags]


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
    """Return commit and state of the checkout that holds this package, of a wheel those of the
    checkout that it was built from; None where they are unknown."""
    checkout = PACKAGE_FOLDER.parent
    if not (checkout / ".git").exists():
        # The commit that the build wrote into a wheel.
        file = PACKAGE_FOLDER / _COMMIT
        try:
            found = json.loads(file.read_text(encoding="utf-8"))
            return {"commit": str(found["commit"]), "dirty": bool(found["dirty"])}
        except (OSError, ValueError, KeyError, TypeError):
            return None
    commit = _ask_git(checkout, "rev-parse", "HEAD")
    # Reports are written while their commands run, and no result depends on them.
    state = _ask_git(checkout, "status", "-s", "--", ".", ":!reports/reference")
    return {"commit": commit, "dirty": None if state is None else bool(state)}


def _ask_git(checkout: Path, *words: str) -> str | None:
    try:
        # With a limit: on a slow network folder git may hang, and only a note is lost.
        done = subprocess.run(
            ["git", "-C", str(checkout), *words], capture_output=True, text=True, timeout=10
        )
    except (OSError, subprocess.TimeoutExpired):
        return None
    return done.stdout.strip() if done.returncode == 0 else None
