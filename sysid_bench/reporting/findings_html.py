"""Page of a diagnosis: findings as a table, measured and fitted torque as figures."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Any, Final

from sysid_bench.reporting.torque_figure import StoredTorque, torque_svg
from sysid_bench.types import Array

STYLE: Final = (
    "body{font:15px/1.5 sans-serif;max-width:60rem;margin:2rem auto;padding:0 1rem}"
    "table{border-collapse:collapse;width:100%}td,th{border-bottom:1px solid #ccc;padding:.4rem;"
    "text-align:left;vertical-align:top}.error{color:#b00020;font-weight:bold}"
    ".warning{color:#a15c00;font-weight:bold}.note{color:#555}code{background:#f3f3f3}"
    "svg{max-width:100%;height:auto}"
)
HEADINGS: Final = ("", "finding", "explains", "what to do", "blind for")


@dataclass(frozen=True, eq=False)
class TorqueFit:
    """Measured torque of a recording and that of the fit near the model, (N, n) at t (N,)."""

    title: str
    t: Array
    rows: Sequence[str]
    measured: Array
    fitted: Array
    units: Sequence[str]


def write_findings_html(
    path: Path,
    title: str,
    findings: Sequence[Mapping[str, Any]],
    torques: Sequence[TorqueFit],
) -> Path:
    """Write the page into an .html file, complete in itself."""
    parts = [
        f"<!doctype html><html lang=en><meta charset=utf-8><title>{escape(title)}</title>",
        f"<style>{STYLE}</style><h1>{escape(title)}</h1>",
        _table(findings),
        *(_figure(torque) for torque in torques),
        "</html>\n",
    ]
    path.write_text("\n".join(parts), encoding="utf-8")
    return path


def _table(findings: Sequence[Mapping[str, Any]]) -> str:
    if not findings:
        return "<p>No finding.</p>"
    head = "".join(f"<th>{heading}</th>" for heading in HEADINGS)
    return f"<table><tr>{head}</tr>{''.join(map(_row, findings))}</table>"


def _row(finding: Mapping[str, Any]) -> str:
    share = finding["explains"]
    cells = [
        f"<span class={finding['severity']}>{finding['severity']}</span>",
        f"<b>{escape(finding['name'])}</b>: {escape(finding['message'])} "
        f"<small>({escape(finding['log'])})</small>",
        "" if share is None else f"{100 * share:.0f} %",
        f"<code>{escape(finding['edit'])}</code>" if finding["edit"] else "",
        escape(finding["blind"]),
    ]
    return "<tr>" + "".join(f"<td>{cell}</td>" for cell in cells) + "</tr>"


def _figure(torque: TorqueFit) -> str:
    rows, units = tuple(torque.rows), tuple(torque.units)
    sample = StoredTorque(torque.title, torque.t, torque.measured, torque.fitted, rows, units)
    drawn = torque_svg(sample)
    caption = (
        f"{torque.title}: filtered torque, and the nearest that a robot much like the model gives "
        "with friction, armature and offset."
    )
    return f"<h2>{escape(torque.title)}</h2><p>{escape(caption)}</p>{drawn}"
