"""Checks of the commands of position controllers: exchanged columns, saturated torques, motors that
are too fast."""

from collections.abc import Iterator
from dataclasses import replace
from typing import Final

import numpy as np

from sysid_bench.diagnosis.diagnose_input import DiagnoseInput
from sysid_bench.diagnosis.finding import ERROR, WARNING, Finding
from sysid_bench.errors import first_names
from sysid_bench.signals.position_control import Commands
from sysid_bench.types import Array

NEARER: Final = 0.5
"""RMS of the positions that past commands in another order do not explain, over that in the stated
order: columns are exchanged below it."""

PAST: Final = (0.0, 0.02, 0.04, 0.08, 0.16)
"""s; ages of the commands that a position follows."""

LEAST: Final = 2
"""Least length of a recording in units of the oldest command."""

FASTER: Final = 1.1
"""Speed over that without load from which a motor is not the one of the table."""

SATURATED: Final = 0.01
"""Share of samples beyond a torque limit that is worth a finding."""


def position_commands(evidence: DiagnoseInput) -> Iterator[Finding]:
    """Yield the findings in the commands of a position controller; none of a measured torque."""
    commands = evidence.log.commands
    if commands is not None:
        yield from _exchanged(commands)
        yield from _saturated(commands, evidence.robot.limits.tau[evidence.dofs])
        yield from _too_fast(commands)


def _exchanged(commands: Commands) -> Iterator[Finding]:
    """Joints that follow the commands of others; none in a recording too short to compare them."""
    if len(commands) <= LEAST * round(max(PAST) * commands.rate):
        return
    errors = _unexplained(commands)
    # Recordings with measured torque do without it.
    from scipy.optimize import linear_sum_assignment

    order = linear_sum_assignment(errors)[1]
    moved = np.flatnonzero(order != np.arange(len(order)))
    now, best = (float(np.sum(errors[moved, at])) for at in (moved, order[moved]))
    if not len(moved) or best > NEARER**2 * now:
        return
    names = tuple(commands.joints[j] for j in moved)
    found = ", ".join(f"{commands.joints[j]} follows that of {commands.joints[order[j]]}"
                      for j in moved[:4])  # fmt: skip
    yield Finding(
        "columns", ERROR,
        f"the commanded positions of {first_names(names)} are exchanged: {found}",
        names, explains=1.0 - best / now,
        blind="joints that are commanded alike, as the legs of a robot that moves all alike",
        edit="tau = { pd = ... }: give the columns of q_des, kp and kd in the order of joints",
    )  # fmt: skip


def _unexplained(commands: Commands) -> Array:
    """Return the share (k, k) of each joint's position that past commands of each joint leave, by
    mean squares."""
    ages = [round(age * commands.rate) for age in PAST]
    used = slice(max(ages), None)
    q = commands.q[used] - commands.q[used].mean(axis=0)
    total = np.maximum(np.sum(q**2, axis=0), np.finfo(float).tiny)
    shares = []
    for q_des in commands.q_des.T:
        past = np.column_stack([np.roll(q_des, age)[used] for age in ages])
        past = past - past.mean(axis=0)
        x = np.linalg.lstsq(past, q, rcond=None)[0]
        left = np.sum((q - past @ x) ** 2, axis=0) / total
        # A joint that moves against a command, as the hip of the other side, does not follow it.
        shares.append(np.where(x.sum(axis=0) > 0.0, left, 1.0))
    return np.array(shares).T


def _saturated(commands: Commands, of_model: Array) -> Iterator[Finding]:
    """Joints whose controller asks for more torque than its limit, or the model's (k,)."""
    limit = np.where(np.isfinite(commands.limit), commands.limit, of_model)
    error, rate = commands.q_des - commands.q, commands.v_des - commands.velocity
    asked = commands.kp * error + commands.kd * rate + commands.feedforward
    low, high = replace(commands, limit=limit).torque_limits(commands.velocity)
    share = np.mean((asked < low) | (asked > high), axis=0)
    beyond = np.flatnonzero(share > SATURATED)
    if not len(beyond):
        return
    worst = int(np.argmax(share))
    names = tuple(commands.joints[j] for j in beyond)
    stated = bool(np.isfinite(commands.limit[beyond]).all())
    cure = "leave such samples out, or record with smaller commands"
    yield Finding(
        "limits", WARNING,
        f"the commands of {first_names(names)} ask for more than "
        f"{'the stated' if stated else 'a'} torque limit, {commands.joints[worst]} in "
        f"{100 * share[worst]:.0f} % of its samples: gains and armature are hidden there",
        names, edit=cure if stated else f"state tau.pd.limit where the drive has one; {cure}",
    )  # fmt: skip


def _too_fast(commands: Commands) -> Iterator[Finding]:
    """Joints that move faster than their motors do without load."""
    if commands.line is None:
        return
    share = np.abs(commands.velocity).max(axis=0) / commands.line[1]
    fast = np.flatnonzero(share > FASTER)
    if not len(fast):
        return
    names, worst = tuple(commands.joints[j] for j in fast), int(np.argmax(share))
    yield Finding(
        "limits", WARNING,
        f"{first_names(names)} moves faster than its motor without load, "
        f"{commands.joints[worst]} {share[worst]:.2g} times: another motor, voltage or gear, "
        "or another unit of q",
        names, blind="slow motions",
        edit="tau = { pd = { motor = ... } }: name the motor that is built in (list motors)",
    )  # fmt: skip
