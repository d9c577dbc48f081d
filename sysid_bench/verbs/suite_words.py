"""Words that suites take besides plug-ins and files, with their meaning."""

from collections.abc import Mapping
from typing import Final

from sysid_bench.reporting.tables import INTERVALS, STATISTICS
from sysid_bench.signals.filter import FORMS
from sysid_bench.words import STATUSES, TERMS

_TERM_TITLES: Final[Mapping[str, str]] = {
    "viscous": "Viscous friction fv of a joint: torque fv v, and fv.OTHER of coupled joints.",
    "coulomb": "Coulomb friction fc of a joint: torque fc sign(v).",
    "offset": "Constant torque of a joint, as of a current sensor or of the grease.",
    "armature": "Inertia Ia of rotor and gear, seen at the joint: torque Ia a.",
    "spring": "Stiffness k of a spring in the joint: torque k (q - reference).",
}
_INTEGRATOR_TITLES: Final[Mapping[str, str]] = {
    "auto": "Semi-implicit Euler where the torque is held over the control period, else "
    "implicitfast.",
    "euler": "Semi-implicit Euler of MuJoCo, implicit in the damping of joints.",
    "implicitfast": "Implicit in velocity without Coriolis derivatives, of MuJoCo.",
    "implicit": "Implicit in velocity with all derivatives, of MuJoCo.",
    "rk4": "Runge-Kutta of fourth order, of MuJoCo.",
}
_STATUS_TITLES: Final[Mapping[str, str]] = {
    "ok": "The cell has its scores.",
    "failed": "The method or the simulation ended without a result; the row has the reason.",
    "timeout": "The cell took longer than `run.timeout`.",
    "crash": "The process of the cell ended by a signal, as of a fault in a library.",
    "memory": "The process of the cell needed more than `run.memory`.",
    "lost": "The machine failed: the process was killed from outside, or storage was full.",
    "unsupported": "The method does not serve this robot, task or recording: a valid result.",
    "skipped": "The robot failed its cross-check, or what the cell needs failed.",
}


def _first_line(thing: type) -> str:
    return str(thing.__doc__).partition("\n")[0]


WORDS: Final[Mapping[str, Mapping[str, str]]] = {
    "terms": {name: _TERM_TITLES[name] for name in TERMS},
    "filters": {form: _first_line(kind) for form, kind in FORMS.items()},
    "integrators": _INTEGRATOR_TITLES,
    "statistics": {name: f"{text.capitalize()}." for name, text in STATISTICS.items()},
    "intervals": {name: f"{text.capitalize()}." for name, text in INTERVALS.items()},
    "statuses": {name: _STATUS_TITLES[name] for name in STATUSES},
}
"""Meaning of each word, by its kind."""


def entry_with_title(kind: str, name: str) -> dict[str, str]:
    """Return a word of a kind with its meaning, as `title`."""
    return {"name": name, "title": WORDS[kind][name]}
