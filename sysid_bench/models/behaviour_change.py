"""Differences of the behaviour of a robot: which joint, and which quantity."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

ROBOT: Final = ""
"""In place of a joint: what belongs to the robot as a whole."""
TORQUE: Final = "torque at five states"
_SAME: Final = 1e-6
"""Relative difference of two numbers that are the same."""

Values = list[Any]
"""Numbers, infinities as texts, or names."""
Behaviour = Mapping[str, Mapping[str, Values]]
"""Joint (or ROBOT) -> quantity -> values."""


@dataclass(frozen=True)
class BehaviourChange:
    """A quantity of a joint of a robot that is another one; `joint` is "" for what belongs to the
    robot as a whole, `before` and `after` are None where there is none."""

    robot: str
    joint: str
    quantity: str
    before: Values | None
    after: Values | None


def behaviour_changes(robot: str, before: Behaviour, after: Behaviour) -> list[BehaviourChange]:
    """Return what differs in two behaviours, causes first: torques, which follow from them, last.

    Values are the same up to a millionth of the largest of their list.
    """
    changes = []
    for joint in dict.fromkeys((*before, *after)):
        old, new = before.get(joint, {}), after.get(joint, {})
        for quantity in dict.fromkeys((*old, *new)):
            a, b = old.get(quantity), new.get(quantity)
            if not _are_same(a, b):
                changes.append(BehaviourChange(robot, joint, quantity, a, b))
    return sorted(changes, key=lambda change: change.quantity == TORQUE)


def _are_same(a: Values | None, b: Values | None) -> bool:
    if a == b or a is None or b is None or len(a) != len(b):
        return a == b
    try:
        both = np.array([a, b], dtype=float)
    except ValueError:  # names
        return False
    finite = np.isfinite(both).all(axis=0)
    numbers = both[:, finite]
    limit = _SAME * np.abs(numbers).max(initial=0.0)
    return bool((both[0] == both[1])[~finite].all() and (np.ptp(numbers, axis=0) <= limit).all())
