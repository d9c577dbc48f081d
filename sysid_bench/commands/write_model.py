"""Model files written again with the identified values."""

import tempfile
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np

from sysid_bench.commands.identify_result import values_of
from sysid_bench.errors import ModelError, UnsupportedError, UsageError
from sysid_bench.experiments.tasks.task import find_task
from sysid_bench.identifiability.base_expressions import parameter_verdict
from sysid_bench.input_files import check_replaceable, is_file, is_folder
from sysid_bench.models.manifest import Manifest
from sysid_bench.models.robot import SUFFIX, RobotModel
from sysid_bench.models.writing.mjcf_writer import update_mjcf
from sysid_bench.models.writing.other_format import converted
from sysid_bench.models.writing.update import update_of
from sysid_bench.models.writing.urdf_writer import update_urdf
from sysid_bench.signals.log_description import LogDescription
from sysid_bench.types import Array, Estimate, Problem

SUFFIXES: Final = {"urdf": (".urdf",), "mjcf": (".xml", ".mjcf")}
KEYS: Final = {"viscous": "damping", "coulomb": "frictionloss", "spring": "stiffness"}
"""Names of joint terms in URDF and MJCF files, where they differ from ours."""


PASSIVE: Final = ("viscous", "coulomb", "armature")
"""Joint terms that must not be negative. A URDF holds the first two, an MJCF springs as well, the
manifest all."""

DEVIATIONS: Final = 3.0
"""Standard deviations below zero from which a joint term counts as negative."""

ROUNDING: Final = 1e-9
"""N m, kg m^2 and the like: smaller ones are errors of rounding."""


def check_files(robot: RobotModel, task: str, model: Path | None, answer: Path | None) -> None:
    """Raise UsageError or UnsupportedError, before anything runs, for files that the identified
    model or the JSON result cannot be written to."""
    sources = (robot.manifest.path, robot.manifest.manifest_file)
    known = [suffix for suffixes in SUFFIXES.values() for suffix in suffixes]
    if model is not None and model.suffix.lower() not in known:
        raise UsageError(
            f"{str(model)!r} cannot hold a model: name it *.urdf or *.xml (MJCF); "
            f"{robot.manifest.path.name} is {'a URDF' if robot.format == 'urdf' else 'an MJCF'}."
        )
    for target in filter(None, (model, answer)):
        _check_target(target, sources)
    if model is not None and not find_task(task).writes_model:
        raise UnsupportedError(
            f"The task {task!r} changes nothing of the robot's model; use the task 'link' for a "
            "model that carries its load."
        )
    if model is not None and answer is not None and answer.resolve() == model.resolve():
        raise UsageError(
            f"{str(answer)!r} cannot hold both the model and the JSON result; name two files."
        )


def _check_target(target: Path, sources: Sequence[Path | None]) -> None:
    """Raise UsageError for a file of the model itself, and for one in a folder that is absent."""
    if is_file(target) and any(_is_same(target, source) for source in sources):
        raise UsageError(f"{str(target)!r} is the model itself; name another file.")
    if not is_folder(target.parent):
        folder = str(target.parent)
        raise UsageError(f"The folder {folder!r} of {target.name} does not exist.")


def check_output_files(
    written: Sequence[Path | None], manifest: Path | None, logs: Sequence[LogDescription]
) -> None:
    """Raise UsageError, before anything runs, where a file to be `written` (model, JSON, figure) is
    one of those that `logs` read, where the JSON would replace a file that is not a result, or
    where the `manifest` beside a model would replace that of another model, or another file."""
    read = [file for log in logs for file in (log.source, *log.files)]
    for target in (*written, manifest):
        if target is None or not is_file(target):
            continue
        beside = " by the joint terms beside --model-out" if target == manifest else ""
        if any(_is_same(target, source) for source in read):
            raise UsageError(
                f"{str(target)!r} is a recording or its description, and would be overwritten"
                f"{beside}; name another file."
            )
        model = written[0]
        if beside and model is not None and (owner := _model_of(target)) != model.name:
            kind = "not a robot's manifest" if owner is None else f"the manifest of {owner}"
            raise UsageError(
                f"{str(target)!r} is {kind}, and would be overwritten{beside} {model.name}; name "
                "another file."
            )
    answer = written[1] if len(written) > 1 else None
    if answer is not None:
        check_replaceable(answer, ('{\n  "model"',), "a result of identify")


def _model_of(file: Path) -> str | None:
    """Return the model file that a robot.toml names, None for another file."""
    try:
        keys = tomllib.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    return str(keys["file"]) if {"name", "file"} <= keys.keys() else None


def _is_same(target: Path, source: Path | None) -> bool:
    """Test whether a source exists and is the target, by any path."""
    # By file and not by path: a link may name the source, too.
    return source is not None and source.exists() and target.samefile(source)


def write_model(
    robot: RobotModel,
    task: str,
    estimate: Estimate,
    problem: Problem,
    target: Path,
    whole: bool = False,
    std: Mapping[str, float | None] | None = None,
) -> list[str]:
    """Write the model with the estimate's values; raise ModelError for what must not be written.
    `whole`: the bodies were completed, so parameters count that are not identifiable alone.

    Friction and rotor inertia that are negative within their deviations `std` are written as zero,
    their bound; they are returned in words.

    Bodies welded to a link that was identified as a whole keep their values; the link gets the
    rest.
    """
    theta = dict(zip(problem.parameters, values_of(estimate, problem).tolist(), strict=True))
    verdict_of = dict(zip(problem.parameters, parameter_verdict(problem.base), strict=True))
    if whole:
        verdict_of = dict.fromkeys(problem.parameters, "identifiable")
    definition = find_task(task)
    # What is left of theta afterwards are parameters of joints.
    bodies = {
        body.name: np.array([theta.pop(column) for column in body.columns])
        for body in problem.bodies
    }
    # The file lists welded bodies one by one; their sum was identified.
    if definition.lumps_welded_bodies:
        bodies = {name: phi - _welded(robot, name) for name, phi in bodies.items()}
    term_of = {suffix: term for term, suffix in SUFFIX.items()}
    joints: dict[str, dict[str, float]] = {}
    at_bound = []
    # What remains behind a sensor are its constants (offsets, gains), which no model file holds.
    for name, value in {} if definition.measures_sensor_only else theta.items():
        joint, _, suffix = name.rpartition(".")
        term = term_of[suffix]
        reach = DEVIATIONS * ((std or {}).get(name) or 0.0)
        if term in PASSIVE and -max(reach, ROUNDING) <= value < 0:
            at_bound += [f"{name} {value:.3g} ± {reach / DEVIATIONS:.2g}"] if reach else []
            value = 0.0
        joints.setdefault(joint, {})[KEYS.get(term, term)] = value
    described = write_values(robot, bodies, joints, verdict_of, target)
    if described is not None:
        from sysid_bench.models.writing.manifest_writer import manifest_text  # loads tomlkit

        named = replace(described, name=target.stem)  # another robot than an installed one
        write_text(target.with_suffix(".toml"), manifest_text(named, target.name))
    return at_bound


def _welded(robot: RobotModel, name: str) -> Array:
    """phi (10,) of all bodies welded to a link in the file, in the link's frame."""
    link = robot.body_names.index(name)
    tree, phi = robot.tree, robot.phi.copy()
    # Neither the link itself nor a payload at the tool counts as welded in the file.
    phi[link] = 0.0
    if robot.payload_body is not None:
        phi[robot.payload_body] = 0.0
    composite: Array = tree.link_parameters(phi)[tree.carrier[link]]
    return composite


def format_of(target: Path) -> str:
    """Return the format, "urdf" or "mjcf", that the suffix of a model file names."""
    return next(form for form, known in SUFFIXES.items() if target.suffix.lower() in known)


def write_values(
    robot: RobotModel,
    bodies: Mapping[str, Array],
    joints: Mapping[str, Mapping[str, float]],
    verdict_of: Mapping[str, str],
    target: Path,
    manifest: Manifest | None = None,
) -> Manifest | None:
    """Write the robot's model file again with phi (10,) by body and terms by joint, in the words of
    the format; raises ModelError for what must not be written.

    In the other format the file has bodies and joints, without shapes, and the manifest that is
    returned, the given one or that of the robot, holds what that format has no place for.
    """
    form, described = format_of(target), None
    with tempfile.TemporaryDirectory() as folder:
        source = robot.manifest.path
        if robot.manifest.text is not None:  # a robot that exists as text alone
            source = Path(folder) / f"robot{SUFFIXES[robot.format][0]}"
            source.write_text(robot.manifest.text, encoding="utf-8")
        if form == robot.format:
            # The file is edited, not generated: comments, meshes and foreign tags stay.
            write = update_urdf if form == "urdf" else update_mjcf
            text = write(source, bodies, joints, verdict_of)
        else:
            update = update_of(source, bodies, joints, verdict_of)
            text, described = converted(update, manifest or robot.manifest, form, target.name)
    write_text(target, text)
    return described


def write_text(target: Path, text: str) -> None:
    """Write a file as UTF-8, its line ends unchanged; raises ModelError where that fails."""
    try:
        target.write_bytes(text.encode())
    except OSError as error:
        raise ModelError(f"{target} cannot be written: {error.strerror or error}.") from error
