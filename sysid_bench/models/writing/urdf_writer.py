"""Writing of identified parameters into a URDF; every other byte of its text stays."""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Final

from sysid_bench.errors import ModelError
from sysid_bench.models.writing.update import Bodies, Joints, Update, update_text
from sysid_bench.models.writing.xml_text import (
    Edit,
    Element,
    edit_values,
    element_edit,
    values_text,
)
from sysid_bench.spatial import body_mass_inertia, inertia_values

_SIX: Final = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
_DYNAMICS: Final = {"damping": "damping", "frictionloss": "friction"}
"""Joint terms of a URDF, MuJoCo's names to those of the URDF."""


def update_urdf(
    path: Path | str,
    bodies: Bodies,
    joints: Joints | None = None,
    verdicts: Mapping[str, str] | None = None,
) -> str:
    """Return the text of a URDF with new inertial parameters and joint friction; nothing else
    changes.

    `bodies`: name -> phi (10,) or (m, com, inertia about it); `joints`: name -> damping,
    frictionloss in SI units; `verdicts`: parameter -> verdict of all that is to be written. The
    text is read again before it is returned. Raises ModelError for values that must not be written
    (see models/writing/update.py), and for joint terms that a URDF cannot hold.
    """
    return update_text(path, bodies, joints, verdicts, "robot", _edits)


def _edits(data: bytes, root: Element, update: Update) -> Iterator[Edit]:
    file = update.robot.manifest.path.name
    for name, phi in update.phi.items():
        link = _called(root, "link", name, file)
        mass, com, inertia = body_mass_inertia(phi)
        moments = zip(_SIX, map(values_text, inertia_values(inertia)), strict=True)
        # The moments are about axes parallel to those of the link: a rotation in the text goes.
        parts: dict[str, dict[str, str]] = {
            "origin": {"xyz": values_text(*com), "rpy": "0 0 0"},
            "mass": {"value": values_text(mass)},
            "inertia": dict(moments),
        }
        inertial = link.find("inertial")
        if inertial is not None:
            for tag, values in parts.items():
                yield from _child_edits(data, inertial, tag, values)
        elif phi.any():
            written = "".join(map(_element, parts.items()))
            yield element_edit(data, link, f"<inertial>{written}</inertial>")
    for name, terms in update.joints.items():
        joint = _called(root, "joint", name, file)
        for key in terms:
            if key not in _DYNAMICS:
                raise ModelError(
                    f"{file}: a URDF has no {key} of joints (joint {joint.attributes['name']!r}); "
                    "write an MJCF, or leave that term out."
                )
        values = {_DYNAMICS[key]: values_text(value) for key, value in terms.items()}
        yield from _child_edits(data, joint, "dynamics", values)


def _called(root: Element, tag: str, name: str, file: str) -> Element:
    for element in root.children:
        if element.tag == tag and element.attributes.get("name") == name:
            return element
    raise ModelError(f"{file}: the {tag} {name!r} is not in the text and cannot be written.")


def _child_edits(
    data: bytes, parent: Element, tag: str, values: Mapping[str, str]
) -> Iterator[Edit]:
    """Edits that set attributes of a child element, which is added where it is absent."""
    present = parent.find(tag)
    if present is None:
        yield element_edit(data, parent, _element((tag, values)))
    else:
        yield from edit_values(data, present, values)


def _element(part: tuple[str, Mapping[str, str]]) -> str:
    tag, values = part
    return (
        f"<{tag} {' '.join(f'{key}={chr(34)}{value}{chr(34)}' for key, value in values.items())}/>"
    )
