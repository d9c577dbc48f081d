"""Commanded motions of experiments; optimised ones are cached by the content of their inputs.

An optimised motion depends on the robot, the task, the limits, the known torques, its settings, its
seed and the code alone. Cells that agree in these share it, within a worker and, through a folder
(`SYSID_BENCH_CACHE`, else the user's cache), between workers and runs.
"""

import hashlib
import os
import tempfile
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from sysid_bench.canonical_json import canonical
from sysid_bench.excitation.design_problem import DesignProblem
from sysid_bench.experiments.loaded_robot import LoadedRobot
from sysid_bench.types import Array, Trajectory
from sysid_bench.versions import package_hash

_DESIGNS: dict[str, Array] = {}


def design_motion(
    excitation: Mapping[str, Any], loaded: LoadedRobot, problem: DesignProblem, seed: int
) -> Trajectory:
    """The motion of an excitation as a suite names it."""
    plugin = loaded.build_plugin("excitation", excitation)
    rng = np.random.default_rng(seed)
    motion: Trajectory
    if not hasattr(plugin, "solve"):
        motion = plugin.design(problem, rng)
        return motion
    key = content_hash([package_hash(), canonical(excitation), seed, loaded.robot.text, problem])
    if key not in _DESIGNS:
        stored = _read_design(key)
        _DESIGNS[key] = (
            _write_design(key, plugin.solve(problem, rng).C) if stored is None else stored
        )
    motion = plugin.motion(_DESIGNS[key], problem)
    return motion


def content_hash(value: Any) -> str:
    """SHA-256 of nested values by their content. Functions are left out, and so is the rate of a
    design problem: coefficients do not depend on the sampling."""
    digest = hashlib.sha256()
    _feed(digest, value)
    return digest.hexdigest()


def _feed(digest: Any, value: Any) -> None:
    digest.update(f"<{type(value).__name__}>".encode())
    if isinstance(value, np.ndarray):
        digest.update(
            f"{value.shape}{value.dtype}".encode() + np.ascontiguousarray(value).tobytes()
        )
    elif is_dataclass(value):
        for field in fields(value):
            if not (isinstance(value, DesignProblem) and field.name == "rate"):
                digest.update(field.name.encode())
                _feed(digest, getattr(value, field.name))
    elif isinstance(value, (list, tuple)):
        for part in value:
            _feed(digest, part)
    elif isinstance(value, Mapping):
        for key in sorted(value):
            _feed(digest, [key, value[key]])
    elif isinstance(value, bytes):
        digest.update(value)
    elif not callable(value):
        digest.update(repr(value).encode())


@cache
def _folder() -> Path:
    named = os.environ.get("SYSID_BENCH_CACHE")
    home = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(named) if named else Path(home) / "sysid_bench"


def _read_design(key: str) -> Array | None:
    try:
        return np.asarray(np.load(_folder() / f"{key}.npy", allow_pickle=False))
    except (OSError, ValueError, EOFError):  # absent or truncated
        return None


def _write_design(key: str, C: Array) -> Array:
    """Store coefficients and return them. An unwritable folder costs the next worker a design."""
    try:
        _folder().mkdir(parents=True, exist_ok=True)
        # Renaming is atomic: no worker reads half a file.
        with tempfile.NamedTemporaryFile(dir=_folder(), suffix=".part", delete=False) as part:
            np.save(part, C)
        Path(part.name).replace(_folder() / f"{key}.npy")
    except OSError:
        pass
    return C
