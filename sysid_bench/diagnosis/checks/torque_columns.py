"""Torque columns in another order than the joints."""

from collections.abc import Iterator, Sequence
from itertools import combinations
from typing import Final

import numpy as np

from sysid_bench.diagnosis.edit import columns_edit
from sysid_bench.diagnosis.hypothesis import Candidate, Hypothesis
from sysid_bench.types import Array

BLIND: Final = "twin joints, whose torques are alike: parallel axes, the fingers of a gripper"
EXCHANGED: Final = 0.5
"""Cost below which three or more columns cannot be exchanged."""


def torque_columns(before: Hypothesis) -> Iterator[Candidate]:
    """Yield candidates that exchange two torque columns, and the best assignment of all columns."""
    n = before.evidence.count
    orders = {tuple(_exchanged(n, pair)) for pair in combinations(range(n), 2)}
    if before.fit.cost > EXCHANGED:
        orders |= {tuple(_assignment(before))} - {tuple(range(n))}
    for order in sorted(orders):
        yield _cure(before, order)


def _exchanged(n: int, pair: tuple[int, int]) -> list[int]:
    order = list(range(n))
    order[pair[0]], order[pair[1]] = pair[1], pair[0]
    return order


def _assignment(before: Hypothesis) -> Sequence[int]:
    """The column of each joint (Hungarian method): the one whose torque alone is nearest to what
    friction and a robot near the model give."""
    from scipy.optimize import linear_sum_assignment  # 0.3 s, which clean recordings need not spend

    n = before.evidence.count
    distance = np.ones((n, n))
    for k in range(n):
        # Joint j with the torque of joint (j + k) mod n: n fits give the whole table.
        order = [(j + k) % n for j in range(n)]
        fit = before.with_torque(_permutation(order)).fit
        distance[range(n), order] = fit.residual
    return [int(i) for i in linear_sum_assignment(distance)[1]]


def _permutation(order: Sequence[int]) -> Array:
    """Matrix P with (T P)[:, j] = T[:, order[j]]."""
    return np.eye(len(order))[:, list(order)]


def _cure(before: Hypothesis, order: Sequence[int]) -> Candidate:
    e = before.evidence
    moved = tuple(j for j, i in enumerate(order) if i != j)
    pairs = ", ".join(f"that of {e.joints[j]} stands with {e.joints[order[j]]}" for j in moved)
    return Candidate(
        name="columns",
        joints=moved,
        hypothesis=before.with_torque(_permutation(order)),
        message=f"torque columns are exchanged: {pairs}",
        edit=columns_edit(e, ["tau"], order),
        blind=BLIND,
    )
