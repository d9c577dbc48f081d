"""Coupling of a robot from its constraints: groups of coupled joints, each with its limits."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from sysid_bench.errors import ModelError, unknown_name
from sysid_bench.models.coupling.constraints import ChainClosure, Constraint, PolynomialCoupling
from sysid_bench.models.coupling.coordinates import Coordinates
from sysid_bench.models.coupling.coupling import Coupling, names_of
from sysid_bench.models.coupling.group import (
    SINGULAR,
    Group,
    closure_limits,
    largest_jacobian,
    residual_jacobian,
)
from sysid_bench.types import Array

RANK: Final = 1e-4
"""Singular values of the scaled J below this, relative to the largest, belong to redundant rows:
rounded lengths in model files leave 1e-6."""

PIVOT: Final = 0.1
"""A joint without motor is dependent where its column rises to this share of the best one, at
least: conditioning comes before convenience."""

LATER: Final = 0.5
"""The same share for a joint later in the tree."""

NEARBY: Final = 0.05
"""rad; distance from the reference at which the rank is compared with that at the reference."""

_REFERENCE: Final = "the model's reference posture (qpos0, or all joints of a URDF at zero)"


def group_constraints(constraints: Sequence[Constraint]) -> list[list[Constraint]]:
    """Return the constraints in groups: those that share a degree of freedom, directly or not."""
    groups: list[tuple[set[int], list[Constraint]]] = []
    for constraint in constraints:
        dofs, members = set(constraint.dofs), [constraint]
        for other in [group for group in groups if group[0] & dofs]:
            groups.remove(other)
            dofs, members = dofs | other[0], other[1] + members
        groups.append((dofs, members))
    return [members for _, members in groups]


def group_of(
    constraints: Sequence[Constraint],
    coordinates: Coordinates,
    names: tuple[str, ...],
    actuated: frozenset[int],
    wanted: frozenset[int],
) -> Group:
    """Return the group of connected constraints; `coordinates` (nv,) of all dofs, `actuated`: dofs
    with a motor, `wanted`: dofs that must be independent.

    Raises ModelError where the wanted dofs cannot all be independent, where no closed posture lies
    near the model's reference posture, and where the closure is singular there.
    """
    dofs = np.unique(np.concatenate([constraint.dofs for constraint in constraints]))
    _, (J,) = residual_jacobian(constraints, dofs, np.zeros((1, len(dofs))))
    units, row_units = _scales(constraints, J, coordinates.lengths[dofs])
    scaled = J * units / row_units[:, None]
    count = _rank(scaled)
    passive = _mimics(constraints) | set(np.flatnonzero(~coordinates.driven).tolist())
    # Those that may be dependent: the passive ones first, which mimic another one or belong to a
    # ball or free joint, then those without a motor, then the rest; each from the end of the tree.
    members = (passive, {*dofs.tolist()} - passive - actuated, actuated - passive)
    end_first = list(enumerate(dofs.tolist()))[::-1]
    kinds = [[k for k, dof in end_first if dof in kind - wanted] for kind in members]
    dependent = _pivots(scaled, kinds, count)
    if len(dependent) < count:
        required = names_of(names, np.array([dof for dof in dofs if int(dof) in wanted]))
        raise ModelError(
            f"coupling.independent: {required} cannot all be independent; of the coupled joints "
            f"{names_of(names, dofs)} only {len(dofs) - count} can."
        )
    group = Group(
        constraints=tuple(constraints),
        dofs=dofs,
        dependent=dependent,
        independent=np.setdiff1d(np.arange(len(dofs)), dependent),
        reference=np.zeros(len(dofs)),
        units=units,
        row_units=row_units,
    )
    return _closed_at_reference(group, names)


def _mimics(constraints: Sequence[Constraint]) -> set[int]:
    """Dofs that are alone on the left side of an equality: polynomials of the others."""
    equalities = [c for c in constraints if isinstance(c, PolynomialCoupling)]
    alone = [c for c in equalities if np.count_nonzero(c.first) == 1]
    return {c.dofs[int(np.argmax(c.first != 0))] for c in alone}


def _scales(constraints: Sequence[Constraint], J: Array, slides: Array) -> tuple[Array, Array]:
    """Scales of coordinates (k,), 1 for a hinge and the longest lever arm of the loops for a slide,
    and of rows (m,): the largest entry of those that have the same unit."""
    first_rows = np.cumsum([0, *(sum(constraint.blocks) for constraint in constraints)])
    loops = [
        row for row, c in zip(first_rows, constraints, strict=False) if isinstance(c, ChainClosure)
    ]
    # Position rows of a loop come first: a hinge moves its end by the lever arm per radian.
    arms = [np.linalg.norm(J[row : row + 3, ~slides], axis=0) for row in loops]
    units = np.where(slides, float(np.max(arms, initial=0.0)) or 1.0, 1.0)
    sizes = np.concatenate([constraint.blocks for constraint in constraints])
    blocks = np.split(J * units, np.cumsum(sizes)[:-1])
    largest = np.array([np.abs(block).max(initial=0.0) for block in blocks])
    return units, np.repeat(np.where(largest > 0, largest, 1.0), sizes)


def _rank(scaled: Array) -> int:
    values = np.linalg.svd(scaled, compute_uv=False)
    return int((values > RANK * values[0]).sum()) if values[0] > 0 else 0


def _pivots(scaled: Array, kinds: list[list[int]], count: int) -> Array:
    """At most `count` independent columns by greedy QR pivoting, of early kinds where they rise
    enough above those chosen."""
    chosen: list[int] = []
    rest = scaled.copy()
    floor = RANK * float(np.linalg.norm(scaled, axis=0).max(initial=0.0))
    while len(chosen) < count:
        heights = np.linalg.norm(rest, axis=0)
        left = [[k for k in kind if k not in chosen] for kind in kinds]
        left = [kind for kind in left if kind]
        tallest = np.array([heights[kind].max() for kind in left])
        if tallest.max(initial=0.0) <= floor:
            break  # all columns left depend on those chosen
        # The earliest kind that comes near the best one; argmax of a mask is its first True.
        kind = left[int(np.argmax(tallest >= PIVOT * tallest.max()))]
        k = kind[int(np.argmax(heights[kind] >= LATER * heights[kind].max()))]
        # Gram-Schmidt: what is left of each column is its part orthogonal to those chosen.
        direction = rest[:, k] / heights[k]
        rest = rest - np.outer(direction, direction @ rest)
        chosen.append(k)
    return np.array(sorted(chosen), dtype=int)


def _closed_at_reference(group: Group, names: tuple[str, ...]) -> Group:
    """The group with its reference closed; refused where the dependent joints are not determined by
    the independent ones there."""
    joints = names_of(names, group.dofs)
    x = group.default_closure(group.reference)
    if x is None:
        raise ModelError(
            f"The coupling of {joints} cannot be closed near {_REFERENCE}; draw the model closed."
        )
    group = replace(group, reference=x)
    least = _branching(group)
    if least is None:
        least = float(group.condition(group.reference[None])[0])
        if least >= SINGULAR:
            return group
    positions = ", ".join(
        f"{names[dof]} at {displacement:.3g}"
        for dof, displacement in zip(group.dofs, group.reference, strict=True)
    )
    raise ModelError(
        f"The coupling of {joints} is singular at {_REFERENCE}: smallest singular value "
        f"{least:.2g} ({positions} from there); draw the model in a posture that is not flat or "
        "stretched."
    )


def _branching(group: Group) -> float | None:
    """A singular value that vanishes at the reference but not nearby, None without one: the closure
    branches there, and the branch of the motion is undetermined."""
    if group.linear or len(group.independent) == 0:
        return None
    _, values, Vt = np.linalg.svd(group.scaled_jacobian(group.reference[None])[0])
    r = len(group.dependent)
    rng = np.random.default_rng(0)
    # Directions in which the closure is free to first order: the null space of J.
    directions = rng.normal(size=(4, len(Vt) - r)) @ Vt[r:]
    directions *= NEARBY / np.abs(directions).max(axis=1, keepdims=True)
    nearby = group.nearest_closure(group.reference + directions * group.units)
    if max(map(_rank, group.scaled_jacobian(nearby))) <= r:
        return None
    return float([*values, 0.0][r])


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
    following = np.sort(np.concatenate([group.dofs[group.dependent] for group in groups]))
    moving = np.setdiff1d(np.arange(len(dofs.names)), following)
    if len(moving) == 0:
        raise ModelError(
            "The equalities fix all joints; there is nothing to identify. Write "
            "couplings = false in a robot.toml to let every joint move on its own."
        )
    low, high, slower = dofs.low.copy(), dofs.high.copy(), np.ones(len(dofs.names))
    bounds = np.array(dofs.stated)
    repairs = []
    for group in groups:
        free, after = group.dofs[group.independent], group.dofs[group.dependent]
        low[free], high[free], slower[free], repair = _group_limits(group, dofs)
        repairs += [repair] if repair else []
        # Ranges are widened to the reference, where motions start even outside the limits.
        here = group.reference[group.dependent] + dofs.q0[after]
        bounds[0, after] = -np.inf if repair else np.minimum(bounds[0, after], here)
        bounds[1, after] = np.inf if repair else np.maximum(bounds[1, after], here)
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


def _groups(
    constraints: Sequence[Constraint],
    dofs: Dofs,
    actuated: Sequence[str],
    independent: Sequence[str],
) -> tuple[Group, ...]:
    for name in independent:
        if name not in dofs.names:
            raise unknown_name("joint in coupling.independent", name, dofs.names)
    motors, wanted = (
        frozenset(dof for dof, name in enumerate(dofs.names) if name in selected)
        for selected in (actuated, independent)
    )
    return tuple(
        group_of(members, dofs.coordinates, dofs.names, motors, wanted)
        for members in group_constraints(constraints)
    )


def _group_limits(group: Group, dofs: Dofs) -> tuple[Array, Array, Array, str]:
    """(low, high, slower) of the independent joints of a group, and ignored limits in words."""
    moving, following = group.dofs[group.independent], group.dofs[group.dependent]
    if len(moving) == 0:
        return np.zeros(0), np.zeros(0), np.ones(0), ""
    q0 = dofs.q0[group.dofs]
    bounds = dofs.stated[0][group.dofs], dofs.stated[1][group.dofs]
    bounds[0][group.independent], bounds[1][group.independent] = dofs.low[moving], dofs.high[moving]
    low, high = closure_limits(group, bounds[0] - q0, bounds[1] - q0)
    least_width = 1e-3 * group.units[group.independent]
    repair = ""
    if not (high - low > least_width).all():
        # Some files couple joints against their own limits; those of dependent joints are dropped.
        bounds[0][group.dependent], bounds[1][group.dependent] = -np.inf, np.inf
        low, high = closure_limits(group, bounds[0] - q0, bounds[1] - q0)
        repair = (
            f"limits of {names_of(dofs.names, following)} ignored: with them, "
            f"{names_of(dofs.names, moving)}, which they follow, could not move"
        )
    if not (high - low > least_width).all():
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
