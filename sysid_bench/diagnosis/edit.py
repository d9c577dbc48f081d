"""Edits of a log's description that correct a mistake, as text."""

from collections.abc import Sequence

import numpy as np

from sysid_bench.diagnosis.diagnose_input import DiagnoseInput
from sysid_bench.signals.log_description import NO_JOINT
from sysid_bench.signals.log_keys import Signal
from sysid_bench.types import Array


def factor_edit(evidence: DiagnoseInput, signal: str, setting: str, factors: Array) -> str:
    """Return the edit that multiplies a setting of a signal by factors (n,) of the joints."""
    return _setting(evidence, signal, setting, factors, np.zeros(evidence.count))


def offset_edit(evidence: DiagnoseInput, signal: str, offsets: Array) -> str:
    """Return the edit that adds offsets (n,) of the joints to a signal."""
    return _setting(evidence, signal, "offset", np.ones(evidence.count), offsets)


def _setting(
    evidence: DiagnoseInput, signal: str, setting: str, factors: Array, summands: Array
) -> str:
    log = evidence.log.description
    if signal == "tau" and log.tau.pd is not None:
        numbers = ", ".join(f"{x:.4g}" for x in (summands if setting == "offset" else factors))
        change = "add to the torque" if setting == "offset" else "multiply kp and kd by"
        return f"tau = {{ pd = ... }}: {change} [{numbers}]"
    part = log.signals[signal]
    values = log.joint_values(f"{signal}.{setting}", getattr(part, setting))
    places = [log.joints.index(joint) for joint in evidence.joints]
    values[places] = values[places] * factors + summands
    text = ", ".join(f"{value:.4g}" for value in values)
    where = ", in the coordinates of the motors" if log.transmission is not None else ""
    return f"{signal} = {{ {setting} = [{text}] }}{where}"


def columns_edit(evidence: DiagnoseInput, signals: Sequence[str], order: Sequence[int]) -> str:
    """Return the edit that gives joint j the columns of joint order[j]."""
    log = evidence.log.description
    parts = [(name, log.signals[name]) for name in signals if name in log.signals]
    if any(len(part.columns or ()) != len(log.joints) for _, part in parts):
        names = ", ".join(evidence.joints[i] for i in order)
        return f"write the columns of {' and '.join(signals)} in the order of {names}"
    places = [log.joints.index(joint) for joint in evidence.joints]
    return "; ".join(
        f"{name} = {{ columns = {_reordered(p, places, order)} }}" for name, p in parts
    )


def _reordered(part: Signal, places: Sequence[int], order: Sequence[int]) -> list[int | str]:
    given = part.columns or ()
    columns = list(given)
    for j, i in enumerate(order):
        columns[places[j]] = given[places[i]]
    return columns


def joints_edit(evidence: DiagnoseInput, order: Sequence[int]) -> str:
    """Return the edit of `joints` that gives joint j the columns of joint order[j]."""
    log = evidence.log.description
    names = list(log.joints)
    places = [k for k, name in enumerate(names) if name != NO_JOINT]
    for j, i in enumerate(order):
        names[places[i]] = evidence.joints[j]
    return f"joints = {names}".replace("'", '"')
