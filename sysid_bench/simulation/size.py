"""Sizes of effects and errors: one number for all joints, one per joint, or drawn from a range."""

from collections.abc import Mapping, Sequence
from typing import Any, Final, TypeGuard

import numpy as np

from sysid_bench.errors import UsageError
from sysid_bench.types import Array
from sysid_bench.units import parse_quantity

Size = float | Sequence[float]
"""A number for all joints, or one per joint."""

ANGLE: Final = "rad|m"
"""Unit of sizes that are angles on hinges and lengths on slides."""

ANGLES: Final = ("", "rad", "mrad", "deg", ANGLE)
"""Units as written that leave open what a slide does, the bare number among them."""

SLIDE: Final = 0.02
"""m: a slide moves by this length where its motor turns a pinion by 1 rad. Angles of gears on
hinges are lengths of the same gear behind a pinion on slides: presliding of 0.2 to 2 mrad becomes
4 to 40 um, as of linear guideways (10 to 50 um, assumed)."""

Range = Mapping[str, Any]
"""{ from = ..., to = ... }: limits of a uniform distribution, as written."""


def joint_size(size: Size, names: Sequence[str], what: str) -> Array:
    """Return a size as an array (n,) for the n joints `names`; raises UsageError for a list of
    another length, and for values that are not finite."""
    values = np.array(size, dtype=float)
    if values.ndim > 1 or (values.ndim == 1 and len(values) != len(names)):
        raise UsageError(
            f"{what} has {values.size} values for the {len(names)} joints {', '.join(names)}; give "
            "one number for all joints, or one for each."
        )
    if not np.isfinite(values).all():
        raise UsageError(f"{what} = {size!r} is not finite.")
    return np.broadcast_to(values, (len(names),)).copy()


def joint_sizes(effect: object, names: Sequence[str], *settings: str) -> list[Array]:
    """Return settings of an effect or error as arrays (n,) for the n joints `names`, by
    `joint_size`."""
    return [joint_size(getattr(effect, setting), names, setting) for setting in settings]


def check_size(what: str, *sizes: Size, above: bool = False) -> None:
    """Raise UsageError for a size below zero, or for zero as well if it has to be `above`."""
    for size in sizes:
        values = np.asarray(size, dtype=float)
        if not (values > 0 if above else values >= 0).all():
            raise UsageError(f"{what} = {size!r}: give {'more than 0' if above else '0 or more'}.")


def is_random(value: Any) -> TypeGuard[Range]:
    """Return True for a size that is drawn, { from = ..., to = ... }."""
    return isinstance(value, Mapping) and bool({"from", "to"} & set(value))


def random_size(limits: tuple[float, float], count: int, rng: np.random.Generator) -> Array:
    """Return `count` sizes, uniform between `limits`; ranges of other widths share their draws."""
    low, high = limits
    return np.asarray(low + (high - low) * rng.random(count))


def is_rotation(written: Any) -> bool:
    """Return True for a number or a range that stands for all joints and states no length."""
    if is_random(written):
        return all(is_rotation(end) for end in written.values())
    if not isinstance(written, (int, float, str)):
        return False
    return parse_quantity(str(written))[1] in ANGLES


def effect_size(values: Array, what: str) -> Array | None:
    """Return the values (n,) where all are above zero, and None where all are zero; raises
    UsageError for a mixture, since an effect replaces a term of all joints or of none."""
    if not values.any():
        return None
    if not (values > 0).all():
        raise UsageError(f"{what} is zero for some joints; give every joint one, or none.")
    return values
