"""Payloads: rigid bodies mounted at the tool frame, by name or as a table."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, Final

import numpy as np

from sysid_bench.errors import UsageError, unknown_name
from sysid_bench.spatial import inertia_matrix, phi_of
from sysid_bench.types import Array
from sysid_bench.units import parse_quantity

_METRES: Final = {"m": 1.0, "cm": 1e-2, "mm": 1e-3}
_KEYS: Final = ("name", "mass", "com", "inertia")
_LARGEST: Final = 1e6  # kg, m, kg m^2; squares of it stay far from overflow


@dataclass(frozen=True)
class Payload:
    """A rigid load: mass (kg), com (m) from the tool frame's origin in its axes, inertia (kg m^2)
    about the centre of mass in the same axes, Ixx Ixy Ixz Iyy Iyz Izz."""

    name: str
    mass: float = 0.0
    com: tuple[float, float, float] = (0.0, 0.0, 0.0)
    inertia: tuple[float, float, float, float, float, float] = (0.0,) * 6

    @property
    def phi(self) -> Array:
        """Inertial parameters (10,) about the tool frame."""
        return phi_of(self.mass, np.array(self.com), inertia_matrix(np.array(self.inertia)))

    def __bool__(self) -> bool:
        return self.mass > 0.0


def _sizes(text: str, words: list[str]) -> Iterator[float]:
    """Yield the sizes (m) of a solid, of which the last word may be the unit of all."""
    unit = words.pop() if words and words[-1] in _METRES else "m"
    for size in words:  # "50" in the unit of the whole solid, or "50mm" in its own
        try:
            number, written = parse_quantity(size)
        except UsageError as error:
            raise UsageError(f"The solid {text!r}: {error}") from error
        if written and written not in _METRES:
            raise UsageError(
                f"The solid {text!r}: {size!r} has the unit {written!r}; expected one of "
                f"{', '.join(_METRES)}."
            )
        yield number * _METRES[written or unit]


def inertia_of(text: str, mass: float) -> tuple[float, float, float, float, float, float]:
    """Return the inertia (kg m^2) about the centre of "box 0.1 0.1 0.2 m", "sphere 0.05 m"
    (radius), "rod 0.3 m" (thin, along x) or "point", of uniform density."""
    word, _, rest = text.strip().partition(" ")
    sizes = list(_sizes(text, rest.split()))
    if not all(0 < size <= _LARGEST for size in sizes):
        raise UsageError(f"The solid {text!r} has a size outside of 0 to {_LARGEST:.0e} m.")
    match word, sizes:
        case "point", []:
            return (0.0,) * 6
        case "sphere", [radius]:  # 2/5 m r^2
            i = 0.4 * mass * radius**2
            return (i, 0.0, 0.0, i, 0.0, i)
        case "rod", [length]:  # thin: no moment about its own axis x
            i = mass * length**2 / 12
            return (0.0, 0.0, 0.0, i, 0.0, i)
        case "box", [x, y, z]:  # about each axis by the other two edges
            k = mass / 12
            return (k * (y**2 + z**2), 0.0, 0.0, k * (x**2 + z**2), 0.0, k * (x**2 + y**2))
    raise UsageError(
        f"{text!r} is not a solid; write 'box X Y Z m', 'sphere RADIUS m', 'rod LENGTH m', "
        "'point', or six numbers Ixx Ixy Ixz Iyy Iyz Izz."
    )


def parse_payload(spec: str | Mapping[str, Any]) -> Payload:
    """Return the payload of a name or of a table {mass, com, inertia, name}; raises UsageError for
    unknown names and keys, numbers out of range, and inertias that are physically impossible."""
    if isinstance(spec, str):
        if spec not in PAYLOADS:
            example = "{ mass = 1.2, com = [0, 0, 0.05], inertia = 'sphere 0.05 m' }"
            raise unknown_name("payload", spec, PAYLOADS, f"Or give a table {example}.")
        return PAYLOADS[spec]
    if not isinstance(spec, Mapping):
        raise UsageError(
            f"{spec!r} is not a payload; give a name ({', '.join(PAYLOADS)}) or a table."
        )
    for key in spec:
        if key not in _KEYS:
            raise unknown_name("key of a payload", str(key), _KEYS)
    mass = _numbers(spec, "mass", [spec.get("mass")], 1)[0]
    if mass <= 0:
        raise UsageError(f"A payload's mass must be positive (kg); got {mass}.")
    com = _numbers(spec, "com", spec.get("com", [0.0, 0.0, 0.0]), 3)
    inertia = spec.get("inertia", "point")
    six = list(inertia_of(inertia, mass)) if isinstance(inertia, str) else inertia
    six = _numbers(spec, "inertia", six, 6)
    place = "-".join(f"{1e3 * c:g}" for c in com)
    name = str(spec.get("name") or f"{mass:g}kg-at-{place}mm")
    # Principal moments of mass in space obey I1 >= 0 and I1 + I2 >= I3; rounding is forgiven.
    moments = np.linalg.eigvalsh(inertia_matrix(np.array(six)))
    slack = 1e-9 * max(moments[-1], 1e-12)
    if moments[0] < -slack or moments[0] + moments[1] < moments[2] - slack:
        raise UsageError(
            f"The payload {name!r} is physically impossible: its principal "
            f"moments {moments.tolist()} violate the triangle inequality; give the inertia "
            "about the centre of mass, in kg m^2."
        )
    return Payload(name, mass, tuple(com), tuple(six))  # type: ignore[arg-type]


def _numbers(spec: Mapping[str, Any], key: str, values: Any, count: int) -> list[float]:
    listed = isinstance(values, (list, tuple)) and len(values) == count
    if not listed or any(isinstance(x, bool) or not isinstance(x, (int, float)) for x in values):
        raise UsageError(
            f"A payload's {key} needs {count} number(s) in SI units; got {spec.get(key)!r}."
        )
    if not all(abs(x) <= _LARGEST for x in values):  # NaN compares false
        raise UsageError(
            f"A payload's {key} must be finite and at most {_LARGEST:.0e}; got {spec.get(key)!r}."
        )
    return [float(x) for x in values]


_NAMED: Final[tuple[tuple[str, float, tuple[float, float, float], str], ...]] = (
    ("none", 0.0, (0.0, 0.0, 0.0), "point"),
    ("point-1kg", 1.0, (0.0, 0.0, 0.0), "point"),
    ("sphere-1kg", 1.0, (0.0, 0.0, 0.05), "sphere 0.05 m"),
    ("sphere-offset-1kg", 1.0, (0.06, -0.04, 0.08), "sphere 0.05 m"),
    ("box-2kg", 2.0, (0.0, 0.0, 0.06), "box 0.1 0.08 0.12 m"),
    ("rod-1kg", 1.0, (0.0, 0.0, 0.02), "rod 0.3 m"),
)
PAYLOADS: Final[Mapping[str, Payload]] = MappingProxyType(
    {name: Payload(name, m, com, inertia_of(solid, m)) for name, m, com, solid in _NAMED}
)
