"""Coupling of a robot from its constraints: groups of coupled joints, each with its limits."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sysid_bench.errors import ModelError, unknown_name
from sysid_bench.models.coupling.closure_limits import closure_limits, largest_jacobian
from sysid_bench.models.coupling.constraints import Constraint
from sysid_bench.models.coupling.coordinates import Coordinates
from sysid_bench.models.coupling.coupling import Coupling, names_of
from sysid_bench.models.coupling.group import Group
from sysid_bench.models.coupling.independent_joints import group_constraints, group_of
from sysid_bench.types import Array


@dataclass(frozen=True, eq=False)
class Dofs:
    """Degrees of freedom (nv,): names, address in q and reference of hinges and slides (-1, 0
    elsewhere), the coordinates of all, and limits in them: `low`, `high`, `v` as motions use them;
    `stated` (low, high, v, a) where manifest or model states them, infinite elsewhere."""

    names: tuple[str, ...]
    qadr: Array
    q0: Array
    coordinates: Coordinates
    low: Array
    high: Array
    v: Array
    stated: tuple[Array, Array, Array, Array]


def coupling_of(
    constraints: Sequence[Constraint],
    dofs: Dofs,
    actuated: Sequence[str] = (),
    independent: Sequence[str] = (),
) -> Coupling:
    """Return the coupling of constraints on degrees of freedom; `actuated` joints are independent
    rather than others, those named in `independent` must be.

    Raises UsageError for an unknown name, ModelError for a coupling that cannot be used.
    """
    groups = _groups(constraints, dofs, actuated, independent)
    moving, following = _independent_and_dependent(groups, len(dofs.names))
    low, high, slower = dofs.low.copy(), dofs.high.copy(), np.ones(len(dofs.names))
    bounds = np.array(dofs.stated)
    repairs = []
    for group in groups:
        free = group.dofs[group.independent]
        low[free], high[free], slower[free], repair = _group_limits(group, dofs)
        repairs += [repair] if repair else []
        bounds[:2, group.dofs[group.dependent]] = _kept_ranges(group, dofs, ignored=bool(repair))
    # Limits of rotations hold where motions are drawn, and are none of the robot's.
    bounds[:, dofs.qadr < 0] = np.array([-np.inf, np.inf, np.inf, np.inf])[:, None]
    return Coupling(
        nv=len(dofs.names),
        names=dofs.names,
        groups=groups,
        independent=moving,
        dependent=following,
        qadr=dofs.qadr,
        q0=dofs.q0,
        coordinates=dofs.coordinates,
        low=low[moving],
        high=high[moving],
        slower=slower[moving],
        bounds=bounds[:, following],
        repairs=tuple(repairs),
    )


def _independent_and_dependent(groups: tuple[Group, ...], nv: int) -> tuple[Array, Array]:
    following = np.sort(np.concatenate([group.dofs[group.dependent] for group in groups]))
    moving = np.setdiff1d(np.arange(nv), following)
    if len(moving) == 0:
        raise ModelError(
            "The equalities fix all joints; there is nothing to identify. Write "
            "couplings = false in a robot.toml to let every joint move on its own."
        )
    return moving, following


def _groups(
    constraints: Sequence[Constraint],
    dofs: Dofs,
    actuated: Sequence[str],
    independent: Sequence[str],
) -> tuple[Group, ...]:
    for name in independent:
        if name not in dofs.names:
            raise unknown_name("joint in coupling.independent", name, dofs.names)
    motors, wanted = _indices(dofs.names, actuated), _indices(dofs.names, independent)
    return tuple(
        group_of(members, dofs.coordinates, dofs.names, motors, wanted)
        for members in group_constraints(constraints)
    )


def _indices(names: tuple[str, ...], selected: Sequence[str]) -> frozenset[int]:
    return frozenset(dof for dof, name in enumerate(names) if name in selected)


def _group_limits(group: Group, dofs: Dofs) -> tuple[Array, Array, Array, str]:
    """(low, high, slower) of the independent joints of a group, and ignored limits in words."""
    moving, following = group.dofs[group.independent], group.dofs[group.dependent]
    if len(moving) == 0:
        return np.zeros(0), np.zeros(0), np.ones(0), ""
    q0 = dofs.q0[group.dofs]
    bounds = dofs.stated[0][group.dofs], dofs.stated[1][group.dofs]
    bounds[0][group.independent], bounds[1][group.independent] = dofs.low[moving], dofs.high[moving]
    low, high = closure_limits(group, bounds[0] - q0, bounds[1] - q0)
    repair = ""
    if not _is_wide(group, low, high):
        # Some files couple joints against their own limits; those of dependent joints are dropped.
        for bound, none in zip(bounds, (-np.inf, np.inf), strict=True):
            bound[group.dependent] = none
        low, high = closure_limits(group, bounds[0] - q0, bounds[1] - q0)
        repair = (
            f"limits of {names_of(dofs.names, following)} ignored: with them, "
            f"{names_of(dofs.names, moving)}, which they follow, could not move"
        )
    if not _is_wide(group, low, high):
        least = float(group.condition(group.reference[None])[0])
        raise ModelError(
            f"The coupling of {names_of(dofs.names, group.dofs)} leaves "
            f"{names_of(dofs.names, moving)} no range: near the reference posture the closure is "
            f"lost or singular (smallest singular value there {least:.2g}); draw the model in a "
            "posture that is not flat or stretched."
        )
    slope = largest_jacobian(group, low, high)
    # A dependent joint is as fast as F v: independent ones slow down until it keeps its limit.
    fastest = slope @ dofs.v[moving]
    with np.errstate(divide="ignore", invalid="ignore"):
        share = np.minimum(1.0, dofs.stated[2][following] / fastest)
    share = np.where(fastest > 0, share, 1.0)
    slower = np.where(slope > 0, share[:, None], 1.0).min(axis=0, initial=1.0)
    return low + dofs.q0[moving], high + dofs.q0[moving], slower, repair


def _kept_ranges(group: Group, dofs: Dofs, ignored: bool) -> tuple[Array, Array]:
    """The range (low, high) of the dependent joints of a group, widened to the reference posture,
    where motions start even outside the limits."""
    after = group.dofs[group.dependent]
    if ignored:
        return np.full(len(after), -np.inf), np.full(len(after), np.inf)
    here = group.reference[group.dependent] + dofs.q0[after]
    return np.minimum(dofs.stated[0][after], here), np.maximum(dofs.stated[1][after], here)


def _is_wide(group: Group, low: Array, high: Array) -> bool:
    return bool((high - low > 1e-3 * group.units[group.independent]).all())
