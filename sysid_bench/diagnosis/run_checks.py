"""Diagnosis of a recording: the checks in their order, up to the first contradiction."""

from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import replace
from typing import Final

from sysid_bench.diagnosis import channel_checks as of_channels
from sysid_bench.diagnosis import joint_checks as of_joints
from sysid_bench.diagnosis.command_checks import position_commands
from sysid_bench.diagnosis.contradictions import contradictions
from sysid_bench.diagnosis.diagnose_input import DiagnoseInput
from sysid_bench.diagnosis.finding import SEVERITIES, WARNING, Finding
from sysid_bench.diagnosis.torque_candidates import open_gains

GROUPS: Final[Sequence[tuple[str, Sequence[Callable[[DiagnoseInput], Iterable[Finding]]]]]] = (
    ("columns and units", (
        of_channels.wrapped_channels, of_channels.recorded_findings, of_channels.static_channels,
        of_joints.unsigned_torque, of_channels.copied_channels,
        of_channels.spikes, of_channels.held_channels, of_channels.clipped_channels,
        position_commands)),
    ("model", (of_joints.model_inertia, of_joints.model_limits)),
    ("signs, columns, gains and geometry", (contradictions, open_gains)),
    ("time", (of_joints.torque_delay,)),
    ("terms", (of_joints.joints_without_fit, of_joints.missing_terms)),
    ("excitation", (of_joints.standstill, of_joints.excitation)),
)  # fmt: skip
"""Groups of checks: a contradiction in one makes the findings of later ones meaningless."""


UNITS: Final = "units"
EXCHANGES: Final = (UNITS, "columns")
"""Name of the contradiction that numbers are beyond what their joint reaches, and of those that
explain it."""


def diagnose(evidence: DiagnoseInput, accept: Collection[str] = ()) -> list[Finding]:
    """Return the findings, the gravest first, of these those with alternatives, and then in the
    order of the groups, up to the first contradiction whose name is not in `accept`.

    Behind an accepted one contradictions are warnings: their tests take for granted what it denies.
    """
    findings: list[Finding] = []
    for _, checks in GROUPS:
        found = [finding for check in checks for finding in check(evidence)]
        if any(one.is_error and one.name != UNITS for one in findings):
            found = [replace(one, severity=WARNING) if one.is_error else one for one in found]
        # Numbers beyond the limits of their joint may be those of another one, and nothing else.
        is_last = contradictions in checks
        if is_last and contradictions_left(findings, accept) and _first(found) not in EXCHANGES:
            found = []
        findings += found
        passed = () if is_last else (UNITS,)
        if contradictions_left(findings, {*accept, *passed}):
            break
    # A defect of a channel costs accuracy; what contradicts the model makes the answer wrong.
    return sorted(findings, key=lambda one: (SEVERITIES.index(one.severity), not one.alternatives))


def _first(found: Sequence[Finding]) -> str:
    return found[0].name if found else ""


def contradictions_left(findings: Sequence[Finding], accept: Collection[str]) -> list[Finding]:
    """Return the contradictions that are not accepted, nor is an explanation that is as likely."""
    return [one for one in findings if one.is_error and not {one.name, *one.as_likely} & {*accept}]
