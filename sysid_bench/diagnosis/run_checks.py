"""Diagnosis of a recording: the checks in their order, up to the first contradiction."""

from collections.abc import Collection, Sequence
from typing import Final

from sysid_bench.diagnosis.checks.clipped_channels import clipped_channels
from sysid_bench.diagnosis.checks.copied_channels import copied_channels
from sysid_bench.diagnosis.checks.excitation import excitation
from sysid_bench.diagnosis.checks.held_channels import held_channels
from sysid_bench.diagnosis.checks.missing_terms import joints_without_fit, missing_terms
from sysid_bench.diagnosis.checks.model_inertia import model_inertia, model_limits
from sysid_bench.diagnosis.checks.position_commands import position_commands
from sysid_bench.diagnosis.checks.recorded_findings import recorded_findings
from sysid_bench.diagnosis.checks.spikes import spikes
from sysid_bench.diagnosis.checks.standstill import standstill
from sysid_bench.diagnosis.checks.static_channels import static_channels
from sysid_bench.diagnosis.checks.torque_delay import torque_delay
from sysid_bench.diagnosis.contradictions import contradictions
from sysid_bench.diagnosis.diagnose_input import DiagnoseInput
from sysid_bench.diagnosis.finding import SEVERITIES, Check, Finding

GROUPS: Final[Sequence[tuple[str, Sequence[Check]]]] = (
    ("columns and units", (recorded_findings, static_channels, copied_channels, spikes,
                           held_channels, clipped_channels, position_commands)),
    ("model", (model_inertia, model_limits)),
    ("signs, columns, gains and geometry", (contradictions,)),
    ("time", (torque_delay,)),
    ("terms", (joints_without_fit, missing_terms)),
    ("excitation", (standstill, excitation)),
)  # fmt: skip
"""Groups of checks: a contradiction in one makes the findings of later ones meaningless."""


def diagnose(evidence: DiagnoseInput, accept: Collection[str] = ()) -> list[Finding]:
    """Return the findings, the gravest first and then in the order of the groups, up to the first
    contradiction whose name is not in `accept`.

    Behind an accepted one contradictions are warnings: their tests take for granted what it denies.
    """
    findings: list[Finding] = []
    for _, checks in GROUPS:
        found = [finding for check in checks for finding in check(evidence)]
        if any(one.is_error for one in findings):
            found = [one.to_warning() for one in found]
        findings += found
        if contradictions_left(findings, accept):
            break
    return sorted(findings, key=lambda one: SEVERITIES.index(one.severity))


def contradictions_left(findings: Sequence[Finding], accept: Collection[str]) -> list[Finding]:
    """Return the contradictions that are not accepted."""
    return [one for one in findings if one.is_error and one.name not in accept]
