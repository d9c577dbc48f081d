"""Commanded motions of experiments, checked whoever made them; optimised ones are cached by the
content of their inputs.

An optimised motion depends on the robot, the task, the limits, the known torques, its settings, its
seed and the code alone. Cells that agree in these share it, within a worker and, through a folder
(`SYSID_BENCH_CACHE`, else the user's cache), between workers and runs.
"""

import hashlib
import io
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass
from functools import singledispatch
from pathlib import Path
from typing import Any, Final

import numpy as np

from sysid_bench.canonical_json import canonical
from sysid_bench.excitation.design_problem import DesignProblem
from sysid_bench.excitation.limit_margins import Margins, check_limits, limit_margins
from sysid_bench.excitation.motion_check import check_motion
from sysid_bench.experiments.loaded_robot import LoadedRobot
from sysid_bench.experiments.spec import checks_limits, without_limits
from sysid_bench.input_files import read_data
from sysid_bench.package_folders import cache_folder
from sysid_bench.types import Array, Trajectory
from sysid_bench.version_fields import package_hash

_DESIGNS: dict[str, Array] = {}

_CHECKSUM: Final = hashlib.sha256().digest_size
"""Bytes before the array in a file of the cache."""


@dataclass(frozen=True, eq=False)
class CommandedMotion:
    """A consistent motion, and what it leaves of the limits of the robot."""

    motion: Trajectory
    margins: Margins


def commanded_motion(
    excitation: Mapping[str, Any], loaded: LoadedRobot, problem: DesignProblem, seed: int
) -> CommandedMotion:
    """The checked motion of an excitation as a suite names it.

    Raises UsageError for a motion that is inconsistent, or that breaks a limit unless the
    excitation has `limits = "mark"`.
    """
    origin = f"excitation {excitation['use']!r}"
    motion = design_motion(without_limits(excitation), loaded, problem, seed)
    check_motion(motion, loaded.robot.joints, problem.rate, origin)
    margins = limit_margins(motion, loaded.robot)
    if checks_limits(excitation):
        check_limits(margins, origin)
    return CommandedMotion(motion, margins)


def design_motion(
    excitation: Mapping[str, Any], loaded: LoadedRobot, problem: DesignProblem, seed: int
) -> Trajectory:
    """The motion of an excitation {use, its own settings}, as the plug-in returns it."""
    plugin = loaded.build_plugin("excitation", excitation)
    rng = np.random.default_rng(seed)
    motion: Trajectory
    if not hasattr(plugin, "solve"):
        motion = plugin.design(problem, rng)
        return motion
    key = design_key([package_hash(), canonical(excitation), seed, loaded.robot.text, problem])
    if key not in _DESIGNS:
        stored = _read_design(key)
        _DESIGNS[key] = (
            _write_design(key, plugin.solve(problem, rng).C) if stored is None else stored
        )
    motion = plugin.motion(_DESIGNS[key], problem)
    return motion


def design_key(value: Any) -> str:
    """SHA-256 of nested inputs of a design by their content. Functions are left out, and so is the
    rate of a design problem: coefficients do not depend on the sampling."""
    digest = hashlib.sha256()
    for part in _typed(value):
        digest.update(part)
    return digest.hexdigest()


def _typed(value: Any) -> Iterator[bytes]:
    """The type of a value, so that 1 and "1" differ, and its content."""
    yield f"<{type(value).__name__}>".encode()
    yield from _content(value)


@singledispatch
def _content(value: Any) -> Iterator[bytes]:
    """The content of a dataclass or a plain value; that of a function is empty."""
    if is_dataclass(value):
        for field in fields(value):
            if not (isinstance(value, DesignProblem) and field.name == "rate"):
                yield field.name.encode()
                yield from _typed(getattr(value, field.name))
    elif not callable(value):
        yield repr(value).encode()


@_content.register
def _(value: np.ndarray) -> Iterator[bytes]:
    yield f"{value.shape}{value.dtype}".encode() + np.ascontiguousarray(value).tobytes()


@_content.register
def _(value: bytes) -> Iterator[bytes]:
    yield value


@_content.register(list)
@_content.register(tuple)
def _(value: Sequence[Any]) -> Iterator[bytes]:
    for part in value:
        yield from _typed(part)


@_content.register(Mapping)
def _(value: Mapping[str, Any]) -> Iterator[bytes]:
    for key in sorted(value):
        yield from _typed([key, value[key]])


def _read_design(key: str) -> Array | None:
    """Return stored coefficients, None where they are absent or damaged."""
    try:
        content = read_data(cache_folder() / f"{key}.design")
        checksum, array = content[:_CHECKSUM], content[_CHECKSUM:]
        if hashlib.sha256(array).digest() != checksum:
            return None
        return np.asarray(np.load(io.BytesIO(array), allow_pickle=False))
    except (OSError, ValueError, EOFError):  # absent or another file
        return None


def _write_design(key: str, C: Array) -> Array:
    """Store coefficients and return them. An unwritable folder costs the next worker a design."""
    try:
        cache_folder().mkdir(parents=True, exist_ok=True)
        # Renaming is atomic: no worker reads half a file.
        array = io.BytesIO()
        np.save(array, C)
        content = hashlib.sha256(array.getvalue()).digest() + array.getvalue()
        with tempfile.NamedTemporaryFile(dir=cache_folder(), suffix=".part", delete=False) as part:
            part.write(content)
        Path(part.name).replace(cache_folder() / f"{key}.design")
    except OSError:
        pass
    return C
