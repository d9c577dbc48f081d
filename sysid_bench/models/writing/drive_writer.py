"""Writing of position actuators into an MJCF; every other byte of its text stays."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from typing import Final
from xml.sax.saxutils import quoteattr

import numpy as np

from sysid_bench.models.writing.xml_text import (
    Edit,
    Element,
    edit_text,
    element_edit,
    element_tree,
    values_text,
)

SECTION: Final = "actuator"


@dataclass(frozen=True)
class PositionDrive:
    """Actuator of a joint: tau = clip(kp (u(t - delay) - q) - kd v, +- limit) - offset.

    `samples`: length of the buffer that holds past inputs, at least the delay over the time step.
    """

    joint: str
    kp: float
    kd: float
    offset: float
    limit: float
    delay: float
    samples: int

    def element(self, name: str) -> str:
        """Return the XML element; settings of classes that would change it are overridden."""
        words: dict[str, str] = {
            "name": name, "joint": self.joint, "gear": "1", "dyntype": "none",
            "gaintype": "fixed", "gainprm": values_text(self.kp), "biastype": "affine",
            "biasprm": values_text(-self.offset, -self.kp, -self.kd), "ctrllimited": "false",
            **self._limits, **self._buffer,
        }  # fmt: skip
        return f"<general {' '.join(f'{k}={quoteattr(x)}' for k, x in words.items())}/>"

    @property
    def _limits(self) -> Mapping[str, str]:
        if not np.isfinite(self.limit):
            return {"forcelimited": "false"}
        # MuJoCo limits the force with its bias, so the limits move with the offset.
        ends = values_text(-self.limit - self.offset, self.limit - self.offset)
        return {"forcelimited": "true", "forcerange": ends}

    @property
    def _buffer(self) -> Mapping[str, str]:
        if self.delay == 0.0:
            return {}
        return {"delay": values_text(self.delay), "nsample": str(self.samples)}


def with_position_actuators(text: str, actuators: Sequence[PositionDrive], name: str) -> str:
    """Return the text of an MJCF in which each actuator replaces the first one of its joint, under
    its name, so that sensors and keyframes still find it; others are added.

    Raises ModelError, with `name`, for a text that is not well-formed XML.
    """
    data = text.encode()
    root = element_tree(data, name)
    return edit_text(data, _edits(data, root, actuators))


def _edits(data: bytes, root: Element, actuators: Sequence[PositionDrive]) -> Iterator[Edit]:
    sections = [child for child in root.children if child.tag == SECTION]
    present = list(chain.from_iterable(section.children for section in sections))
    added = []
    for actuator in actuators:
        of_joint = [one for one in present if one.attributes.get("joint") == actuator.joint]
        if of_joint:
            yield from _replacements(data, of_joint, actuator)
        else:
            added.append(actuator.element(f"{actuator.joint}_position"))
    if added and sections:
        yield element_edit(data, sections[0], "\n".join(added))
    elif added:
        yield _new_section(root, added)


def _new_section(root: Element, added: Sequence[str]) -> Edit:
    lines = "".join(f"    {one}\n" for one in added)
    return Edit(root.tail, root.tail, f"\n  <{SECTION}>\n{lines}  </{SECTION}>\n")


def _replacements(
    data: bytes, present: Sequence[Element], actuator: PositionDrive
) -> Iterator[Edit]:
    """Yield the edit of the first actuator of a joint, and those that remove the others."""
    first, *others = present
    label = first.attributes.get("name", f"{actuator.joint}_position")
    yield _replacement(data, first, actuator.element(label))
    yield from (_replacement(data, other, "") for other in others)


def _replacement(data: bytes, element: Element, text: str) -> Edit:
    """Return the edit that replaces an element with all that is in it."""
    end = element.tail if element.empty else data.index(b">", element.tail) + 1
    return Edit(element.start, end, text)
