"""A recording made by Pinocchio: the parameters lie within their intervals as often as stated."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest

from sysid_bench.commands.identify import identify
from sysid_bench.types import Array
from tests.robots import named_robot
from tests.signals.logs import Recorded, recorded, write

DRAWS = 50
NOISE = 0.05
"""Noise of each torque over its RMS."""

FRICTION = (1.1, 0.6, 0.02)
"""Viscous and Coulomb friction and rotor inertia of every joint (SI)."""

TERMS = ("viscous", "coulomb", "armature")
"""The joint terms of FRICTION."""

SUFFIXES = ("fv", "fc")
"""Those that are base parameters of their own in all joints."""


def torque(log: Recorded, a: Array) -> Array:
    """Torque (N, n) by Pinocchio's own model of the file, with rotors and friction."""
    model = pin.buildModelFromXML(named_robot("ur5").text.decode())
    data = model.createData()
    states = zip(log.q, log.v, a, strict=True)
    rigid = np.array([pin.rnea(model, data, *state) for state in states])
    viscous, coulomb, rotor = FRICTION
    return np.asarray(rigid + viscous * log.v + coulomb * np.sign(log.v) + rotor * a)


@pytest.mark.long
def test_parameters_lie_within_their_intervals(tmp_path: Path) -> None:
    log = recorded(named_robot("ur5"), 0)
    # The acceleration that the identification takes from v: it has no error of its own.
    exact = torque(log, np.gradient(log.v, log.t, axis=0))
    clean = base_parameters(write(tmp_path, replace(log, tau=exact), name="clean"))
    truth = np.array([entry["value"] for entry in clean])
    for term, friction in zip(SUFFIXES, FRICTION[:2], strict=True):
        same = [entry["value"] for entry in clean if entry["expression"].endswith(f".{term}")]
        assert same == pytest.approx([friction] * 6, rel=1e-8)
    rng = np.random.default_rng(0)
    sizes = np.asarray(NOISE * np.sqrt(np.mean(exact**2, axis=0)))
    inside = []
    for _ in range(DRAWS):
        noisy = replace(log, tau=exact + sizes * rng.normal(size=exact.shape))
        base = base_parameters(write(tmp_path, noisy))
        value, std = (np.array([entry[key] for entry in base]) for key in ("value", "std"))
        inside.append(np.abs(value - truth) <= 1.96 * std)
    assert 0.90 <= np.mean(inside) <= 0.98
    # One parameter in 50 draws: 95 % with a deviation of 3.1 %; the least of about 50 parameters.
    assert np.mean(inside, axis=0).min() >= 0.80


def base_parameters(path: Path) -> list[dict[str, Any]]:
    """Base parameters of a recording."""
    return list(identify("ur5", log=path, terms=TERMS, filter="none", derivatives="from v")["base"])
