"""Identified values into the file that the robot came from."""

import contextlib
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Final

from sysid_bench.errors import UnsupportedError, UsageError
from sysid_bench.identifiability.verdicts import verdicts
from sysid_bench.models.robot import SUFFIX, RobotModel
from sysid_bench.models.writing.mjcf_writer import updated_mjcf
from sysid_bench.models.writing.urdf_writer import updated_urdf
from sysid_bench.tasks.task import named_task
from sysid_bench.types import Array, Estimate, Problem
from sysid_bench.verbs.result import values_of

SUFFIXES: Final = {"urdf": (".urdf",), "mjcf": (".xml", ".mjcf")}
KEYS: Final = {"viscous": "damping", "coulomb": "frictionloss", "spring": "stiffness"}
"""Joint terms that files call otherwise."""


def check_target(robot: RobotModel, task: str, target: Path) -> None:
    """Raises UsageError for a file that the model cannot be written to, before anything runs."""
    wanted = SUFFIXES[robot.format]
    source = robot.manifest.path
    if target.suffix.lower() not in wanted:
        raise UsageError(
            f"{str(target)!r} cannot hold {source.name}, which is written back in its own format: "
            f"name it *{wanted[0]}."
        )
    _check_place(robot, target)
    if not named_task(task).writes_model:
        raise UnsupportedError(
            f"The task {task!r} changes nothing of the robot's model; for a model that carries its "
            "load take the task 'link'."
        )


def check_estimate(robot: RobotModel, target: Path, model: Path | None) -> None:
    """Raises UsageError for a file that the answer must not be written to; `model`: where the
    model goes."""
    _check_place(robot, target)
    if model is not None and target.resolve() == model.resolve():
        raise UsageError(f"{str(target)!r} is to hold the model and the answer; name two files.")


def _check_place(robot: RobotModel, target: Path) -> None:
    for own in (robot.manifest.path, robot.manifest.manifest_file):
        if own is not None and target.exists() and own.exists() and target.samefile(own):
            raise UsageError(f"{str(target)!r} is the model itself; write beside it.")
    if not target.parent.is_dir():
        raise UsageError(f"There is no folder {str(target.parent)!r} to write {target.name} to.")


def write_model(
    robot: RobotModel,
    task: str,
    estimate: Estimate,
    problem: Problem,
    target: Path,
    whole: bool = False,
) -> None:
    """Writes the model with the estimate's values; raises ModelError for what must not be written.
    `whole`: they were completed, so that those count too that are not identifiable alone.

    Bodies welded to a link that was identified as a whole stay as they are; the link gets the rest.
    """
    definition = named_task(task)
    theta = dict(zip(problem.parameters, values_of(estimate, problem), strict=True))
    seen = ("identifiable",) * len(problem.parameters) if whole else verdicts(problem.base)
    told = dict(zip(problem.parameters, seen, strict=True))
    bodies = {}
    for body in problem.bodies:
        phi = [theta.pop(column) for column in body.columns]
        lumped = definition.lumps_welded_bodies
        bodies[body.name] = phi - _riders(robot, body.name) if lumped else phi
    joints: dict[str, dict[str, float]] = {}
    term_of = {suffix: term for term, suffix in SUFFIX.items()}
    # Behind a sensor what is left are its constants, and no model holds those.
    for name, value in theta.items() if not definition.measures_sensor_only else ():
        joint, _, suffix = name.rpartition(".")
        term = term_of[suffix]
        joints.setdefault(joint, {})[KEYS.get(term, term)] = float(value)
    write = updated_urdf if robot.format == "urdf" else updated_mjcf
    with _source(robot) as source:
        target.write_bytes(write(source, bodies, joints, told).encode())


@contextlib.contextmanager
def _source(robot: RobotModel) -> Iterator[Path]:
    """The file that a robot was read from; for one that was never a file, one with its text."""
    if robot.manifest.text is None:
        yield robot.manifest.path
        return
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / f"robot{SUFFIXES[robot.format][0]}"
        file.write_text(robot.manifest.text, encoding="utf-8")
        yield file


def _riders(robot: RobotModel, name: str) -> Array:
    """phi (10,) of all that is welded to a link in the file, in the link's frame."""
    own = robot.body_names.index(name)
    tree, phi = robot.tree, robot.phi.copy()
    phi[own] = 0.0
    if robot.payload_body is not None:
        phi[robot.payload_body] = 0.0
    return tree.composite_links(phi)[tree.carrier[own]]
