"""Findings of the linter, and the model that its rules read."""

import re
import xml.etree.ElementTree as ET
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Final, Literal

import mujoco
import numpy as np

from sysid_bench.models.robot import RobotModel
from sysid_bench.models.shape import body_extents
from sysid_bench.spatial import body_mass_inertia
from sysid_bench.types import Array, BodyExtents

Severity = Literal["error", "warning", "note"]
SEVERITIES: Final[tuple[Severity, ...]] = ("error", "warning", "note")


@dataclass(frozen=True)
class LintFinding:
    """What is wrong with an element of a model: `rule` names the check, `element` the body or joint
    ("" for the whole model), `advice` says what to do, `line` where it is in the file."""

    rule: str
    severity: Severity
    element: str
    message: str
    advice: str
    file: str = ""
    line: int | None = None

    @property
    def text(self) -> str:
        """file:line: severity rule: message; advice."""
        place = f"{self.file}:{self.line}" if self.line else self.file
        where = f"{self.element}: " if self.element else ""
        return f"{place}: {self.severity} {self.rule}: {where}{self.message}; {self.advice}"


@dataclass(frozen=True)
class BodyMass:
    """Mass (kg), centre of mass (m) and inertia about it (kg m^2) of a body, in its frame."""

    name: str
    mass: float
    com: Array
    inertia: Array

    @property
    def gyration(self) -> float:
        """Largest radius of gyration (m)."""
        moments = np.linalg.eigvalsh(self.inertia)
        return float(np.sqrt(max(moments[2], 0.0) / self.mass)) if self.mass > 0 else 0.0


@dataclass(frozen=True, eq=False)
class LintInput:
    """A model file: its text, its root element, and the robot, repaired where that was needed."""

    path: Path
    text: bytes
    root: ET.Element
    robot: RobotModel

    @cached_property
    def bodies(self) -> tuple[BodyMass, ...]:
        """Bodies of the robot in the order of `robot.body_names`."""
        found = zip(self.robot.body_names, self.robot.phi, strict=True)
        return tuple(BodyMass(name, *body_mass_inertia(phi)) for name, phi in found)

    @cached_property
    def extents(self) -> Mapping[str, BodyExtents]:
        """Generous bounding boxes of the bodies."""
        return body_extents(self.robot)

    @cached_property
    def moving(self) -> tuple[int, ...]:
        """Indices of the bodies that a joint moves, themselves or through a body above them."""
        carrier = self.robot.tree.carrier
        return tuple(i for i, link in enumerate(carrier) if link >= 0)

    @cached_property
    def joint_inertia(self) -> Array:
        """Diagonal of the mass matrix (nv,) at the reference position, kg m^2 or kg."""
        M = np.zeros((self.robot.mj.nv, self.robot.mj.nv))
        mujoco.mj_fullM(self.robot.mj, self._reference, M)
        return np.diag(M).copy()

    def joint_axes(self, body: int) -> Array:
        """Rates of rotation (3, nv) of a body of MuJoCo's for unit rates of the joints, in its
        frame, at the reference position."""
        rates = np.zeros((3, self.robot.mj.nv))
        mujoco.mj_jacBody(self.robot.mj, self._reference, None, rates, body)
        return np.asarray(self._reference.xmat[body].reshape(3, 3).T @ rates)

    @cached_property
    def _reference(self) -> mujoco.MjData:
        data = mujoco.MjData(self.robot.mj)
        mujoco.mj_forward(self.robot.mj, data)
        return data

    def line_of(self, name: str) -> int | None:
        """Line of the element with a name; None where the text does not have it."""
        pattern = rb"<(?:link|joint|body)\b[^>]*?\bname\s*=\s*[\"']" + re.escape(name.encode())
        found = re.search(pattern + rb"[\"']", self.text)
        return None if found is None else 1 + self.text.count(b"\n", 0, found.start())
