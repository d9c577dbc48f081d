"""Choice of the independent joints of a group, and the closed posture that motions start from."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from sysid_bench.errors import ModelError
from sysid_bench.models.coupling.constraints import Constraint, Loop, Relation
from sysid_bench.models.coupling.group import SINGULAR, Group, equation
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
    slides: Array,
    names: tuple[str, ...],
    actuated: frozenset[int],
    wanted: frozenset[int],
) -> Group:
    """Return the group of connected constraints; `slides` (nv,): True for lengths, `actuated`: dofs
    with a motor, `wanted`: dofs that must be independent.

    Raises ModelError where the wanted dofs cannot all be independent, where no closed posture lies
    near the model's reference posture, and where the closure is singular there.
    """
    dofs = np.array(sorted({dof for constraint in constraints for dof in constraint.dofs}))
    _, J = equation(constraints, dofs, np.zeros((1, len(dofs))))
    units = _units(constraints, J[0], slides[dofs])
    row_units = _row_units(constraints, J[0] * units)
    scaled = J[0] * units / row_units[:, None]
    count = _rank(scaled)
    allowed = [
        [k for k in columns if int(dofs[k]) not in wanted]
        for columns in _followers_first(constraints, dofs, actuated)
    ]
    dependent = _pivots(scaled, [columns for columns in allowed if columns], count)
    if len(dependent) < count:
        required = ", ".join(names[dof] for dof in dofs if int(dof) in wanted)
        raise ModelError(
            f"coupling.independent: {required} cannot all be independent; of the coupled joints "
            f"{', '.join(names[dof] for dof in dofs)} only {len(dofs) - count} can."
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


def _units(constraints: Sequence[Constraint], J: Array, slides: Array) -> Array:
    """Scales (k,) of coordinates: 1 for a hinge, the longest lever arm of the loops for a slide."""
    length, row = 0.0, 0
    for constraint in constraints:
        if isinstance(constraint, Loop):
            arms = np.linalg.norm(J[row : row + 3, ~slides], axis=0)
            length = max(length, float(arms.max(initial=0.0)))
        row += _rows(constraint)
    return np.where(slides, length or 1.0, 1.0)


def _row_units(constraints: Sequence[Constraint], scaled: Array) -> Array:
    """Scales (m,) of rows: the largest entry of the rows that have the same unit."""
    units, row = np.ones(len(scaled)), 0
    for constraint in constraints:
        size = 3 if isinstance(constraint, Loop) else 1
        for start in range(row, row + _rows(constraint), size):
            part = slice(start, start + size)
            units[part] = np.abs(scaled[part]).max(initial=0.0) or 1.0
        row += _rows(constraint)
    return units


def _rows(constraint: Constraint) -> int:
    if isinstance(constraint, Relation):
        return 1
    return 6 if constraint.rigid else 3


def _rank(scaled: Array) -> int:
    values = np.linalg.svd(scaled, compute_uv=False)
    return int((values > RANK * values[0]).sum()) if values[0] > 0 else 0


def _followers_first(
    constraints: Sequence[Constraint], dofs: Array, actuated: frozenset[int]
) -> list[list[int]]:
    """Indices in `dofs`: those that mimic another one, those without a motor, the rest; each from
    the end of the tree."""
    mimics = {
        constraint.dofs[int(np.flatnonzero(constraint.first)[0])]
        for constraint in constraints
        if isinstance(constraint, Relation) and np.count_nonzero(constraint.first) == 1
    }

    kinds: list[list[int]] = [[], [], []]
    for k in reversed(range(len(dofs))):
        dof = int(dofs[k])
        kinds[0 if dof in mimics else 1 if dof not in actuated else 2].append(k)
    return kinds


def _pivots(scaled: Array, kinds: list[list[int]], count: int) -> Array:
    """At most `count` independent columns by greedy QR pivoting, of early kinds where they rise
    enough above those chosen."""
    chosen: list[int] = []
    rest = scaled.copy()
    floor = RANK * float(np.linalg.norm(scaled, axis=0).max(initial=0.0))
    while len(chosen) < count and kinds:
        heights = np.linalg.norm(rest, axis=0)
        best = max(heights[k] for kind in kinds for k in kind)
        if best <= floor:
            break
        kind = next(kind for kind in kinds if heights[kind].max() >= PIVOT * best)
        k = next(k for k in kind if heights[k] >= LATER * heights[kind].max())
        direction = rest[:, k] / heights[k]
        rest = rest - np.outer(direction, direction @ rest)
        chosen.append(k)
        left = ([other for other in kind if other != k] for kind in kinds)
        kinds = [kind for kind in left if kind]
    return np.array(sorted(chosen), dtype=int)


def _closed_at_reference(group: Group, names: tuple[str, ...]) -> Group:
    joints = ", ".join(names[dof] for dof in group.dofs)
    where = "the model's reference posture (qpos0, or all joints of a URDF at zero)"
    x = group.reference_closure(group.reference)
    if x is None:
        raise ModelError(
            f"The coupling of {joints} cannot be closed near {where}; draw the model closed."
        )
    group = replace(group, reference=x)
    value = float(group.condition(x[None])[0])
    branching = _branching(group)
    if value < SINGULAR or branching is not None:
        least = value if branching is None else branching
        positions = ", ".join(
            f"{names[dof]} at {displacement:.3g}"
            for dof, displacement in zip(group.dofs, x, strict=True)
        )
        raise ModelError(
            f"The coupling of {joints} is singular at {where}: smallest singular value {least:.2g} "
            f"({positions} from there); draw the model in a posture that is not flat or stretched."
        )
    return group


def _branching(group: Group) -> float | None:
    """A singular value that vanishes at the reference but not nearby, None without one: the closure
    branches there, and the branch of the motion is undetermined."""
    if group.linear or len(group.independent) == 0:
        return None
    here = group.scaled_jacobian(group.reference[None])[0]
    _, values, Vt = np.linalg.svd(here)
    r = len(group.dependent)
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(4, len(Vt) - r)) @ Vt[r:]
    directions *= NEARBY / np.abs(directions).max(axis=1, keepdims=True)
    for x in group.least_squares_closure(group.reference + directions * group.units):
        if _rank(group.scaled_jacobian(x[None])[0]) > r:
            return float(values[r]) if r < len(values) else 0.0
    return None
