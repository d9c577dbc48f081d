"""Commanded motions of experiments; what is costly to design is designed once, by content.

A design hangs on the robot, the task, the limits, what is known of torques, its settings, its seed
and the code, and on nothing else: cells that agree in these share it, within a worker and through a
folder (`SYSID_BENCH_CACHE`, else the user's cache) between workers and runs.
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
from sysid_bench.experiments.robot_cache import LoadedRobot
from sysid_bench.types import Array, Trajectory
from sysid_bench.versions import code_and_libraries

_DESIGNS: dict[str, Array] = {}


def design_motion(
    excitation: Mapping[str, Any], subject: LoadedRobot, brief: DesignProblem, seed: int
) -> Trajectory:
    """The motion of an excitation as a suite names it."""
    made = subject.build_plugin("excitation", excitation)
    rng = np.random.default_rng(seed)
    if not hasattr(made, "solve"):
        motion: Trajectory = made.design(brief, rng)
        return motion
    key = content_hash(
        [code_and_libraries(), canonical(excitation), seed, subject.robot.text, brief]
    )
    if key not in _DESIGNS:
        kept = _kept(key)
        _DESIGNS[key] = _keep(key, made.solve(brief, rng).C) if kept is None else kept
    again: Trajectory = made.motion(_DESIGNS[key], brief)
    return again


def content_hash(value: Any) -> str:
    """A hash of nested values by what they hold; functions, and a brief's rate, are left out."""
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


def _kept(key: str) -> Array | None:
    try:
        return np.asarray(np.load(_folder() / f"{key}.npy", allow_pickle=False))
    except (OSError, ValueError, EOFError):  # absent, or cut off
        return None


def _keep(key: str, C: Array) -> Array:
    """Writes beside and renames, so that no worker reads half a file; where nothing can be written
    the design is made again by the next worker."""
    try:
        _folder().mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile(dir=_folder(), suffix=".part", delete=False) as part:
            np.save(part, C)
        Path(part.name).replace(_folder() / f"{key}.npy")
    except OSError:
        pass
    return C
