"""Certificate of a force/torque sensor as JSON fields and as text."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from typing import Any, Final

from sysid_bench.errors import count_text
from sysid_bench.identifiability.base_expressions import expression
from sysid_bench.identifiability.sensor_certificate import sensor_certificate
from sysid_bench.models.robot import RobotModel
from sysid_bench.models.sensor import SensorSubtree

SHOWN_TERMS: Final = 4
"""Parameters of a direction that the text lists; JSON has all."""

SMALL: Final = 1e-6
"""Share of a torque that nearly dependent parameters may carry without being mentioned."""

TREE: Final = (
    "the joints behind the sensor move independently, so its wrench suffices for their torques "
    "(Traversaro et al. 2015, Proposition 1)"
)
COUPLED: Final = (
    "joints behind the sensor are coupled, so Proposition 1 of Traversaro et al. (2015), which "
    "assumes independent joints, does not apply; tested by row spaces"
)


def certificate_fields(robot: RobotModel, cut: SensorSubtree) -> dict[str, Any]:
    """Return which torques of drives the sensor predicts in every motion, the directions that it
    cannot see, and what to add."""
    certificate = sensor_certificate(robot, cut)
    return {
        "coupled": certificate.coupled,
        "hypothesis": COUPLED if certificate.coupled else TREE,
        "rank": certificate.rank,
        "predictable": list(certificate.predictable),
        "unpredictable": list(certificate.unpredictable),
        "drives": [
            asdict(drive) | {"predictable": drive.predictable} for drive in certificate.drives
        ],
        "partial": list(certificate.partial),
        "additions": [asdict(addition) for addition in certificate.additions],
    }


def certificate_lines(fields: Mapping[str, Any]) -> Iterator[str]:
    """Yield the text: the theorem with its hypothesis, joints by name, directions and advice."""
    yield f"    torques by structure: {fields['hypothesis']}"
    yield f"    predictable in every motion: {', '.join(fields['predictable']) or 'none'}"
    for drive in fields["drives"]:
        if not drive["predictable"]:
            yield from _drive_lines(drive)
        elif drive["dropped"] > SMALL:
            yield (
                f"      {drive['name']} to {drive['dropped']:.1e} only: parameters that are nearly "
                "dependent are dropped from the base parameters"
            )
    for name in fields["partial"]:
        yield f"    not predictable: {name}, which also moves joints proximal to the sensor"
    yield from _addition_lines(fields["additions"])


def _addition_lines(additions: Sequence[Mapping[str, Any]]) -> Iterator[str]:
    """The torques to add, and the further sensor that makes most torques predictable."""
    torques = [entry for entry in additions if entry["kind"] == "torque"]
    sensors = [entry for entry in additions if entry["kind"] == "sensor"]
    for entry in [*torques, *sorted(sensors, key=lambda entry: -len(entry["predicts"]))[:1]]:
        what = "the torque of" if entry["kind"] == "torque" else "a sensor at"
        yield (
            f"      adding {what} {entry['name']}: {entry['rank']} more base parameters, makes "
            f"{', '.join(entry['predicts']) or 'nothing else'} predictable"
        )


def _drive_lines(drive: Mapping[str, Any]) -> Iterator[str]:
    followers = f" (with {', '.join(drive['followers'])})" if drive["followers"] else ""
    terms = list(drive["direction"].items())
    more = len(terms) - SHOWN_TERMS
    rest = f" and {count_text(more, 'more term')} (--json)" if more > 0 else ""
    yield (
        f"    not predictable: {drive['name']}{followers}, residual {drive['residual']:.1e} of its "
        "regressor"
    )
    yield (
        f"      {expression(dict(terms[:SHOWN_TERMS]))}{rest}: changes its torque by up to "
        f"{drive['effect']:.2g} {drive['unit']}, and the wrench never"
    )
