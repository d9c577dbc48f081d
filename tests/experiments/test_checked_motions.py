"""Motions of others are checked: none that breaks a limit, or whose v is not the derivative of q,
yields an ok row, wherever in the motion the mistake is."""

from pathlib import Path
from typing import Any

import pytest

from sysid_bench.errors import UsageError
from sysid_bench.types import Row
from tests.experiments.experiment_world import ready

CODE = '''
from dataclasses import dataclass, replace

import numpy as np

from sysid_bench.excitation.random_motions import Fourier


@dataclass(frozen=True)
class Altered:
    """A Fourier series, altered at `place` (a share of its length) over `samples`."""

    mistake: str = ""
    place: float = 0.0
    samples: int = 1

    def design(self, brief, rng):
        motion = Fourier(period=4.0, cycles=1).design(brief, rng)
        if self.mistake == "fast":
            return replace(motion, v=4 * motion.v, a=4 * motion.a)
        first = round(self.place * (len(motion) - self.samples))
        part = slice(first, first + self.samples)
        v, a = motion.v.copy(), motion.a.copy()
        if self.mistake == "v":
            v[part] += 0.2 * np.abs(v).max(axis=0)
        if self.mistake == "limits":
            v[part], a[part] = 4 * brief.v, 4 * brief.a
        return replace(motion, v=v, a=a)
'''
QUICK = '''
from dataclasses import replace

from sysid_bench.excitation.random_motions import Fourier


class Quick:
    """Four times the limits of v and a, all derivatives correct."""

    def design(self, brief, rng):
        return Fourier(period=4.0, cycles=1).design(
            replace(brief, low=4 * brief.low, high=4 * brief.high, v=4 * brief.v, a=4 * brief.a),
            rng,
        )
'''


def prepare_fields(**changes: Any) -> Row:
    """The shared fields of the rows of an experiment, for which all motions are designed."""
    return ready(robot="tx40", **changes).fields


@pytest.fixture
def plugin(tmp_path: Path) -> dict[str, Any]:
    """The plug-in file of a user."""
    file = tmp_path / "altered.py"
    file.write_text(CODE)
    return {"use": f"file:{file}:Altered"}


@pytest.mark.parametrize("place", [0.0, 0.5, 1.0])
@pytest.mark.parametrize("mistake", ["v", "limits"])
@pytest.mark.parametrize("role", ["excitation", "held_out"])
def test_a_mistake_is_found_in_first_middle_and_last_place(
    plugin: dict[str, Any], role: str, mistake: str, place: float
) -> None:
    motion = {**plugin, "mistake": mistake, "place": place}
    given = motion if role == "excitation" else ({"use": "ptp", "moves": 2}, motion)
    with pytest.raises(UsageError, match=r"Altered.*differs from the differences of [qv] at"):
        prepare_fields(**{role: given})


def test_the_unaltered_plugin_yields_margins_and_a_scaled_one_is_refused(
    plugin: dict[str, Any],
) -> None:
    fields = prepare_fields(excitation=plugin)
    assert fields["limits_broken"] == ""
    assert all(0.0 < fields[f"{name}_margin"] < 1.0 for name in "qva")
    with pytest.raises(UsageError, match="differs from the differences of q"):
        ready(robot="tx40", excitation={**plugin, "mistake": "fast"})


def test_a_motion_at_four_times_the_limits_is_refused_unless_marking_is_declared(
    tmp_path: Path,
) -> None:
    file = tmp_path / "quick.py"
    file.write_text(QUICK)
    use = {"use": f"file:{file}:Quick"}
    with pytest.raises(UsageError, match=r"of \w+ exceeds its limit by .* slow the motion down"):
        ready(robot="tx40", excitation=use)
    with pytest.raises(UsageError, match="exceeds its limit"):
        prepare_fields(held_out=(use,))
    fields = prepare_fields(excitation={**use, "limits": "mark"})
    assert "exceeds its limit" in fields["limits_broken"]
    assert min(fields["v_margin"], fields["a_margin"]) < -2.0
