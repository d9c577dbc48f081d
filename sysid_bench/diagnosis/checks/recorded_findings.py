"""Findings of the reader: units, rate, velocities, held, lost and invalid samples, limits."""

from typing import Final

from sysid_bench.diagnosis.diagnose_input import DiagnoseInput
from sysid_bench.diagnosis.finding import ERROR, NOTE, WARNING, Finding
from sysid_bench.signals.log_checks import Finding as ReaderFinding

MANY: Final = 0.02
"""Share of the samples from which a defect is a warning; fewer are noted."""
ADVICE: Final = {
    "rate": "correct rate, or the unit of time",
    "velocity": "correct the columns, the unit or the ratio of v",
    "units": "correct unit, gain, ratio or offset",
    "held": "correct rate to that of the data, or record faster",
    "lost": "give time = the column of stamps",
    "non-finite": "rows = [first, last] without the damaged part",
    "time": "rows = [first, last] within one run of the clock",
    "delay": "state tau.pd.delay",
    "limits": "correct q.offset, or the limits of the model",
}


def recorded_findings(evidence: DiagnoseInput) -> list[Finding]:
    """Return the findings made while the recording was read."""
    return [_finding(evidence, one) for one in evidence.log.findings]


def _advice(evidence: DiagnoseInput, name: str) -> str:
    if name == "lost" and evidence.log.description.time is not None:
        return "record at a rate that the recorder keeps; few lost samples do little harm"
    return ADVICE.get(name, "")


def _finding(evidence: DiagnoseInput, one: ReaderFinding) -> Finding:
    few = one.name in ("limits", "held") or one.count <= MANY * evidence.log.samples
    return Finding(
        name=one.name,
        severity=ERROR if one.contradiction else NOTE if few else WARNING,
        message=one.text,
        edit=_advice(evidence, one.name),
    )
