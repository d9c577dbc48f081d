"""Values of an identification without noise, equal to the truth but for rounding."""

import math
from collections.abc import Mapping
from typing import Any, Final

import numpy as np

from sysid_bench.types import Array

LARGEST: Final = 1e-9
"""Largest error, over the largest base parameter, that counts as rounding."""
_SMALLEST: Final = 1e-15

Fields = dict[str, Any]


def exact_share(beta: Array, beta_true: Array) -> float | None:
    """Power of ten above max |beta - beta*| / max |beta*|; None where that is not rounding."""
    scale = np.abs(beta_true).max(initial=0.0)
    share = float(np.abs(beta - beta_true).max(initial=0.0) / scale) if scale > 0 else math.inf
    if not share <= LARGEST:
        return None
    return float(f"1e{math.ceil(math.log10(max(share, _SMALLEST)))}")


def exact_base(base: list[Fields], smallest: float) -> list[Fields]:
    """Entries of base parameters without deviations; values up to `smallest` are 0."""
    return [_exact(entry, smallest) for entry in base]


def exact_joints(joints: Mapping[str, Mapping[str, Fields]], smallest: float) -> dict[str, Any]:
    """Terms of joints without deviations; values up to `smallest` are 0."""
    return {
        joint: {term: _exact(entry, smallest) for term, entry in terms.items()}
        for joint, terms in joints.items()
    }


def _exact(entry: Fields, smallest: float) -> Fields:
    return {**entry, "value": _without_rounding(entry["value"], smallest), "std": None}


def exact_bodies(bodies: Mapping[str, Fields], smallest: float) -> dict[str, Fields]:
    """Bodies without deviations; parameters up to `smallest` are 0."""
    return {
        name: {
            **body,
            "parameters": {
                k: _without_rounding(v, smallest) for k, v in body["parameters"].items()
            },
            "std": dict.fromkeys(body["std"]),
        }
        for name, body in bodies.items()
    }


def _without_rounding(value: float | None, smallest: float) -> float | None:
    return 0.0 if value is not None and abs(value) <= smallest else value
