"""Published values of actuators, from the file `published.json` beside a recording."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from sysid_bench.errors import UsageError, unknown_name
from sysid_bench.input_files import read_text
from sysid_bench.types import Array

FILE: Final = "published.json"
_WORDS: Final = ("armature", "damping", "frictionloss")


@dataclass(frozen=True, eq=False)
class PublishedDrives:
    """Values (k, 4) in the order of UNKNOWNS, and the bias (k,) of the encoders (rad, m), of which
    a publication may have the opposite sign."""

    values: Array
    bias: Array


def published_drives(name: str, recording: Path, joints: Sequence[str]) -> PublishedDrives:
    """Return the values `name` of the file beside a recording: {name: {"joints": {joint: {armature,
    damping, frictionloss, bias}}}}, without a bias zero.

    Raises UsageError for a file, name, joint or value that is not there.
    """
    file = recording.parent / FILE
    known = _sets(file)
    if name not in known:
        raise unknown_name(f"set of values in {file.name}", name, known)
    try:
        terms = [[known[name][joint][word] for word in _WORDS] + [0.0] for joint in joints]
        bias = [known[name][joint].get("bias", 0.0) for joint in joints]
    except KeyError as error:
        raise UsageError(
            f"{file}: {name} has no {error} for each of {', '.join(joints)}."
        ) from error
    return PublishedDrives(np.array(terms, dtype=float), np.array(bias, dtype=float))


def _sets(file: Path) -> dict[str, Any]:
    """The joints of each set of values in a file, by name."""
    try:
        written = json.loads(read_text(file))
    except (OSError, ValueError) as error:
        raise UsageError(f"{file} has no published values: {error}.") from error
    return {key: one["joints"] for key, one in written.items() if _has_joints(one)}


def _has_joints(one: Any) -> bool:
    return isinstance(one, Mapping) and isinstance(one.get("joints"), Mapping)
