"""Data of a suite's [[paper]] entries, stored when a cell runs: reports need no robot or log.

A cell's folder `paper/` holds NAME.json (model, base parameters) or NAME.npz (torques, curves).
"""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np

from sysid_bench.errors import UsageError, reason_of
from sysid_bench.experiments.base_table import base_table
from sysid_bench.experiments.estimate_curves import estimate_curves
from sysid_bench.experiments.experiment_data import ExperimentData
from sysid_bench.experiments.motion_curves import motion_curves
from sysid_bench.experiments.recorded.source import LogTorque, RecordedSource, predict_log
from sysid_bench.identifiability.base_expressions import base_expressions
from sysid_bench.models.dh_table import paper_table
from sysid_bench.models.load import load_robot
from sysid_bench.models.manifest import Manifest, find_manifest
from sysid_bench.types import Array, Curve, Estimate

FOLDER: Final = "paper"


def write_paper_data(
    argument: Mapping[str, Any], cell: str, estimate: Estimate, prepared: ExperimentData[Any]
) -> None:
    """Write the files of `argument["papers"][cell]` below `argument["artifacts"]` (see
    harness/job.py), where the cell is ok.

    Never raises for an entry that cannot be had: its file holds the reason.
    """
    entries = argument.get("papers", {}).get(cell, ())
    if estimate.status != "ok" or not entries or "artifacts" not in argument:
        return
    folder = Path(argument["artifacts"]) / cell / FOLDER
    folder.mkdir(parents=True, exist_ok=True)
    for entry in entries:
        _store_or_explain(argument, entry, folder, estimate, prepared)


def _store_or_explain(
    argument: Mapping[str, Any],
    entry: Mapping[str, Any],
    folder: Path,
    estimate: Estimate,
    prepared: ExperimentData[Any],
) -> None:
    try:
        _store(argument, entry, folder, estimate, prepared)
    except Exception as error:
        _write_json(folder, entry["name"], {"error": reason_of(error)})


def _store(
    argument: Mapping[str, Any],
    entry: Mapping[str, Any],
    folder: Path,
    estimate: Estimate,
    prepared: ExperimentData[Any],
) -> None:
    name, shown = entry["name"], entry["show"]
    if shown == "model":
        _write_json(folder, name, _model(_manifest_of(argument)))
        return
    if shown in ("motion", "online"):
        _write_curves(folder, name, _curves(shown, prepared))
        return
    if not isinstance(prepared.source, RecordedSource) or estimate.beta is None:
        raise UsageError(f"it shows {shown} of recordings; select a cell of a [[log]].")
    if shown == "base-parameters":
        found = _base_parameters(_manifest_of(argument), prepared, estimate.beta)
        _write_json(folder, name, found)
        return
    _write_torques(folder, name, predict_log(prepared, estimate.beta, entry["test"]))


def _manifest_of(argument: Mapping[str, Any]) -> Manifest:
    """The manifest of the robot as the suite names it, without the joints that logs lock."""
    places = [None if argument[k] is None else Path(argument[k]) for k in ("robots_dir", "folder")]
    return find_manifest(argument["experiment"]["robot"], *places)


def _write_torques(folder: Path, name: str, found: LogTorque) -> None:
    units = [kind.removeprefix("joint ") for kind in found.problem.kinds]
    np.savez_compressed(
        folder / f"{name}.npz",
        rows=found.problem.rows,
        units=units,
        t=found.t,
        measured=found.measured,
        predicted=found.predicted,
    )


def _curves(shown: str, prepared: ExperimentData[Any]) -> tuple[Curve, ...]:
    """The motion of the training, or the on-line curves; raises UsageError where there are none."""
    if shown == "motion":
        source, recording = prepared.source, prepared.experiment.recording
        if isinstance(source, RecordedSource):
            recording = source.training[0].recording
        curves = motion_curves(prepared.robot, recording.motion)
    else:
        curves = estimate_curves(prepared)
    if not curves:
        raise UsageError(
            "there is no joint whose motion can be drawn."
            if shown == "motion"
            else "it shows an on-line estimate; select a cell of the task wrench that has a prior."
        )
    return curves


def _write_curves(folder: Path, name: str, curves: tuple[Curve, ...]) -> None:
    """Write t0 (K,), series0 (names), values0 (S, K) and so on, with names, units and limits."""
    arrays: dict[str, Any] = {
        "curves": [curve.name for curve in curves],
        "units": [curve.unit for curve in curves],
        "limits": [curve.limits or (np.nan, np.nan) for curve in curves],
    }
    for k, curve in enumerate(curves):
        arrays |= {
            f"t{k}": curve.t,
            f"series{k}": list(curve.series),
            f"values{k}": np.array(list(curve.series.values())),
        }
    np.savez_compressed(folder / f"{name}.npz", **arrays)


def _model(manifest: Manifest) -> dict[str, Any]:
    """The kinematic table where the robot has one, else its joints; limits in rad or m."""
    if manifest.dh is not None and manifest.manifest_file is not None:
        head, rows, lengths = paper_table(manifest.manifest_file.parent / manifest.dh.table)
        return {"robot": manifest.name, "head": head, "rows": rows, "lengths": dict(lengths)}
    robot = load_robot(manifest)
    low, high = robot.limits.q_low, robot.limits.q_high
    rows = tuple(
        (joint.name, joint.kind, f"{low[joint.vadr]:.4g}", f"{high[joint.vadr]:.4g}")
        for joint in robot.joints
    )
    head = ("joint", "kind", "from", "to")
    return {"robot": manifest.name, "head": head, "rows": rows, "lengths": {}}


def _base_parameters(
    manifest: Manifest, prepared: ExperimentData[RecordedSource], beta: Array
) -> dict[str, Any]:
    """The table of the robot's manifest with these values; `extra` are columns besides the robot's,
    as friction features have them."""
    base, unknowns = prepared.problem.base, prepared.source.builder.unknowns
    given = [
        {"terms": terms, "value": float(value)}
        for terms, value in zip(base_expressions(base), beta, strict=True)
    ]
    table = base_table(load_robot(manifest), unknowns.terms, None, {"base": given})
    named = zip(base.names, beta.tolist(), strict=True)
    return {
        "zero": table["zero"],
        "smallest_change": table["smallest_change"],
        "rows": [
            {k: row[k] for k in ("expression", "value", "impossible")} for row in table["rows"]
        ],
        "extra": {name: value for name, value in named if name in unknowns.extra},
    }


def _write_json(folder: Path, name: str, content: Mapping[str, Any]) -> None:
    (folder / f"{name}.json").write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
