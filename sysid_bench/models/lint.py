"""Checks of a model file: load it as the product does, then ask each check."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import Final

from sysid_bench.errors import ModelError, StaticModelError, reason_of
from sysid_bench.models.lint_input import SEVERITIES, LintFinding, LintInput
from sysid_bench.models.lint_rules import (
    axes,
    drive_inertia,
    inertia_size,
    limbs,
    limits,
    mass_positions,
    mass_size,
    missing_mass,
    placeholder_inertia,
    written_inertia,
)
from sysid_bench.models.load import load_robot
from sysid_bench.models.manifest import Manifest, find_manifest, read_manifest
from sysid_bench.models.sources import model_files
from sysid_bench.models.xml_file import parse_xml, read_file

Check = Callable[[LintInput], Iterator[LintFinding]]


def _units(model: LintInput) -> Iterator[LintFinding]:
    """Values that look like millimetres, degrees or g mm^2."""
    for repair in model.robot.repairs:
        if repair.endswith("?"):
            yield LintFinding("units", "warning", "", repair, "SI units: m, rad, kg, kg m^2")


CHECKS: Final[tuple[Check, ...]] = (
    written_inertia, placeholder_inertia, mass_size, missing_mass,
    mass_positions, inertia_size, limits, drive_inertia, axes,
    limbs, _units,
)  # fmt: skip


def lint_model(manifest: Manifest) -> list[LintFinding]:
    """Findings of a model, errors first, without those that its manifest suppresses.

    A model that cannot be loaded has one finding, its error.
    """
    file = str(manifest.path)
    try:
        robot = load_robot(manifest)
    except StaticModelError as error:
        advice = "leave it out where robots are checked"
        return [LintFinding("motionless", "note", "", str(error).rstrip("."), advice, file)]
    except Exception as error:  # one file never takes the others with it
        return [_not_loaded(error, file)]
    text = robot.text if manifest.text is not None else read_file(manifest.path)
    model = LintInput(manifest.path, text, parse_xml(text, manifest.path.name), robot)
    placed = []
    for finding in chain.from_iterable(check(model) for check in CHECKS):
        # A manifest suppresses a rule, or a rule of one element ("mass:link3").
        names = {finding.rule, f"{finding.rule}:{finding.element}"}
        if names.isdisjoint(manifest.suppressed):
            line = model.line_of(finding.element) if finding.element else None
            placed.append(replace(finding, file=file, line=line))
    return sorted(placed, key=lambda finding: SEVERITIES.index(finding.severity))


def _not_loaded(error: Exception, file: str) -> LintFinding:
    advice = "try the corrected file with 'sysid-bench crosscheck'"
    return LintFinding("load", "error", "", reason_of(error).rstrip("."), advice, file)


def find_model_files(folder: Path) -> tuple[list[Manifest], list[LintFinding]]:
    """Models below a folder, which may read any file in it: that of each robot.toml, then the model
    files that none of these names; and a finding for each robot.toml that cannot be read."""
    found: list[Manifest] = []
    broken: list[LintFinding] = []
    for file in sorted(folder.rglob("robot.toml")):
        try:
            found.append(read_manifest(file))
        except ModelError as error:
            broken.append(_not_loaded(error, str(file)))
    named = {manifest.path.resolve() for manifest in found}
    rest = [file for file in model_files(folder) if file.resolve() not in named]
    lone = (replace(find_manifest(f"file:{file}"), assets=folder) for file in rest)
    return [*found, *lone], broken
