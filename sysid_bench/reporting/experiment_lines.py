"""Assumptions behind the numbers of a report, as (title, text) lines."""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Final

from sysid_bench.errors import count_text
from sysid_bench.reporting.selection import label
from sysid_bench.words import RECORDED

if TYPE_CHECKING:
    import pandas as pd

_SETTINGS: Final = (
    ("Simulation", "simulation"), ("Excitation", "excitation"), ("Rate", "rate"),
    ("Noise", "noise"), ("Signals", "signals"), ("Pipeline", "pipeline"),
    ("Held-out motions", "held_out"),
)  # fmt: skip
_PLANTS: Final = {"matched": " (the robot with exactly the terms of its model)"}
_EMPTY: Final = {"noise": "exact"}
"""Reading of an empty setting by key; that of every other key is "default"."""


def experiment_lines(suite: Mapping[str, Any], cells: "pd.DataFrame") -> list[tuple[str, str]]:
    """Assumptions behind the numbers, from the suite, else from the cells."""
    defaults = suite.get("defaults") or {}
    plant = _setting(defaults, cells, "plant")
    lines = [
        ("Data", _data(cells)),
        ("Task", _setting(defaults, cells, "task")),
        ("Plant", plant + _PLANTS.get(plant, "")),
        ("Prior knowledge given to methods", _prior(_setting(defaults, cells, "prior"))),
        *((title, _setting(defaults, cells, key)) for title, key in _SETTINGS),
        ("Repeats", _repeats(suite.get("run") or {})),
        ("Payload and link tasks", "Payload and link tasks take the rest of the robot as known."),
        ("Scores", _scores(cells)),
    ]
    return [line for line in lines if line[1]]


def _data(cells: "pd.DataFrame") -> str:
    plants = set(map(label, cells.get("plant", ())))
    if RECORDED not in plants:
        return "Simulated with MuJoCo; no real robot was measured."
    alone = plants == {RECORDED}
    return f"Recorded on robots{'' if alone else ', and simulated with MuJoCo'}."


def _scores(cells: "pd.DataFrame") -> str:
    plants = set(map(label, cells.get("plant", ())))
    kinds = {
        "noise-free torque of held-out motions": plants != {RECORDED},
        "measured torque of held-out recordings": RECORDED in plants,
    }
    return f"Torque errors are against the {' or the '.join(k for k, v in kinds.items() if v)}."


def _prior(text: str) -> str:
    # A prior that is drawn around the truth names the deviation of a mass.
    return text + " (standard deviations of a draw around the truth)" if "mass" in text else text


def _repeats(run: Mapping[str, Any]) -> str:
    if "repeats" not in run:
        return ""
    return count_text(run["repeats"], "noise draw")


def _setting(defaults: Mapping[str, Any], cells: "pd.DataFrame", key: str) -> str:
    """Choices of a setting: those that the suite declares, else those that the cells have."""
    if key in defaults:
        return "; ".join(_declared(key, defaults[key]))
    return "; ".join(dict.fromkeys(map(label, cells.get(key, ()))))


def _declared(key: str, value: Any) -> list[str]:
    choices = value if isinstance(value, list) else [value]
    empty = _EMPTY.get(key, "default")
    return [empty if choice == {} else label(choice) for choice in choices]
