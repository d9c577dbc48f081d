"""One robot, one question: the best motion within its limits, as a file for its controller."""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from sysid_bench.errors import UsageError, unknown_name

if TYPE_CHECKING:
    from sysid_bench.excitation.design_problem import DesignProblem
    from sysid_bench.excitation.export.commands import Commands
    from sysid_bench.excitation.optimised import Optimised
    from sysid_bench.models.robot import RobotModel
    from sysid_bench.types import Array, Trajectory

EXPORTS: Final = ("csv", "ros2", "damiao", "can")
RESTING: Final = "fourier-polynomial"
"""The family of curves of hardware exports: it starts and ends at rest."""

Told = Callable[[int, float], None]


def excite(
    robot: str | Path,
    objective: str | Mapping[str, float] = "cond",
    out: str | Path | None = None,
    export: str | None = None,
    task: str = "robot",
    payload: str = "none",
    sensor: str | None = None,
    terms: Sequence[str] | None = None,
    settings: Mapping[str, Any] | None = None,
    limits: Mapping[str, Sequence[float]] | None = None,
    motors: Mapping[str, Mapping[str, Any]] | None = None,
    clamp: float = 0.01,
    after: Sequence[str | Path] = (),
    rate: float = 200.0,
    seed: int = 0,
    robots_dir: Path | None = None,
    tell: Told = lambda count, value: None,
) -> dict[str, Any]:
    """Designs a motion and writes it; the answer as `excite --json` prints it.

    `settings` are those of the excitation `optimised` (family, harmonics, period, joints, ...);
    `limits` replaces the robot's: v, a, tau, one number for all or one per degree of freedom;
    `motors` by joint for Damiao exports; `after`: CSV files of motions that have been recorded.
    Raises UsageError for unknown words, UnsupportedError where no motion keeps the limits.
    """
    import numpy as np

    from sysid_bench.canonical_json import plain
    from sysid_bench.excitation.design_problem import design_problem
    from sysid_bench.excitation.geometry import collision_model
    from sysid_bench.excitation.information import information_model, torque_model
    from sysid_bench.excitation.optimised import Optimised, design_figures, torque_prior
    from sysid_bench.identifiability.structural import structural_base
    from sysid_bench.models.load import load_robot
    from sysid_bench.models.payload import parse_payload
    from sysid_bench.tasks.task import named_task

    kind = _export(export, out)
    start = time.perf_counter()
    model = load_robot(robot, parse_payload(payload), robots_dir=robots_dir)
    definition = named_task(task)
    chosen = definition.default_terms(model) if terms is None else tuple(terms)
    asked = definition.unknowns(model, chosen, sensor, None)
    base = structural_base(model, asked.parameters, asked.rows, asked.cuts)
    scenes: dict[float | None, Any] = {}
    brief = replace(
        design_problem(model, rate),
        regress=information_model(model, base.names, asked.rows, asked.cuts),
        torque=torque_model(model),
        scene=lambda floor: scenes.setdefault(floor, collision_model(model, floor)),
        **_limits(model.torque_rows, limits or {}),
    )
    options: dict[str, Any] = {"clearance": 0.01, **(settings or {})}
    if kind in ("ros2", "damiao", "can"):
        options.setdefault("family", RESTING)
    made = Optimised(objective=objective, **options)
    # Nothing long before everything that can be wrong has been looked at.
    joints = _names(brief, made.space(brief).dofs)
    drives = _drives(kind, joints, motors)
    known = [_recorded(Path(file), brief, joints, made) for file in after]
    design = made.solve(brief, np.random.default_rng(seed), known, tell)
    space = made.space(brief)
    rng = np.random.default_rng(seed)  # the draws that the search began with
    draws = made.draws(space, rng)
    assert brief.regress is not None
    told = torque_prior(space, brief.regress, draws)
    grid = space.curves.grid()
    told_figures = design_figures(told, space.motion(design.C, grid))
    random = [design_figures(told, space.motion(C, grid)) for C in draws]
    used = made.report(design.C, brief)
    violations = [
        {"kind": one.kind, "at": one.name, "share": one.use}
        for one in used.values()
        if not one.use <= 1.0
    ]
    motion = made.motion(design.C, brief)
    answer = {
        "robot": model.name,
        "task": task,
        "payload": payload,
        "terms": list(chosen),
        "objective": objective,
        "family": made.family,
        "harmonics": made.harmonics,
        "period": made.period,
        "cycles": made.cycles,
        "joints": list(joints),
        "seed": seed,
        "rate": rate,
        **told_figures,
        "of": base.rank,
        **{f"start_{key}": float(np.median([r[key] for r in random])) for key in _COMPARED},
        "evaluations": design.evaluations,
        "interrupted": design.interrupted,
        "limits": {one.kind: one.to_json() for one in used.values()},
        "violations": violations,
        "rest": bool(np.abs(motion.v[[0, -1]]).max() < 1e-3),
        "geometry": _geometry(brief, made),
        "warnings": [],
        "file": None if out is None else str(out),
    }
    if out is not None:
        answer["warnings"] += _write(kind, Path(out), model, motion, joints, drives, clamp, answer)
    answer["seconds"] = time.perf_counter() - start
    return dict(plain(answer))


_COMPARED: Final = ("condition", "condition_unit", "log_det", "smallest_singular_value")


def summary(answer: Mapping[str, Any]) -> list[str]:
    """What `excite` tells, in a few lines."""
    lines = [
        f"{answer['robot']}, task {answer['task']}: {answer['family']}, "
        f"{answer['harmonics']} harmonics of {answer['period']:g} s, "
        f"rank {answer['rank']} of {answer['of']}",
        f"  condition {answer['condition']:.4g} (median random motion "
        f"{answer['start_condition']:.4g}), log det {answer['log_det']:.5g} "
        f"({answer['start_log_det']:.5g}); {answer['evaluations']} evaluations, "
        f"{answer['seconds']:.1f} s",
    ]
    for kind, used in answer["limits"].items():
        lines.append(
            f"  {kind:<12} {used['value']:9.4g} of {used['limit']:.4g} {used['unit']}, "
            f"margin {used['margin']:.3g} ({used['at']})"
        )
    if not answer["violations"]:
        lines.append("  no limit is violated on a grid ten times finer than that of the search")
    lines.append(f"  shapes: {answer['geometry']['note']}")
    if answer["interrupted"]:
        lines.append("  interrupted: this is the best feasible motion so far")
    lines += [f"  warning: {warning}" for warning in answer["warnings"]]
    if answer["file"]:
        lines.append(f"  file: {answer['file']}")
    return lines


def _export(export: str | None, out: str | Path | None) -> str:
    kind = export or "csv"
    if kind not in EXPORTS:
        raise unknown_name("export", kind, EXPORTS)
    if out is None and export is not None:
        raise UsageError("Where does the export go? Give a file: -o FILE.")
    if out is not None and not Path(out).parent.is_dir():
        raise UsageError(f"There is no folder {str(Path(out).parent)!r} to write the motion to.")
    return kind


def _names(brief: "DesignProblem", dofs: "Array") -> tuple[str, ...]:
    names = {joint.vadr: joint.name for joint in brief.joints}
    return tuple(names[int(dof)] for dof in brief.dofs[dofs])


def _limits(rows: tuple[str, ...], told: Mapping[str, Sequence[float]]) -> dict[str, Any]:
    import numpy as np

    limits = {}
    for key, values in told.items():
        if key not in ("v", "a", "tau"):
            raise unknown_name("limit", key, ("v", "a", "tau"), "Positions come from the robot.")
        numbers = np.array(values, dtype=float)
        if len(numbers) not in (1, len(rows)) or not (numbers > 0).all():
            raise UsageError(
                f"The limit {key} needs one positive number, or {len(rows)}, one for each of "
                f"{', '.join(rows)}; got {', '.join(map(str, values))}."
            )
        limits[key] = np.broadcast_to(numbers, len(rows)).copy()
    return limits


def _drives(
    kind: str, joints: tuple[str, ...], motors: Mapping[str, Mapping[str, Any]] | None
) -> tuple[Any, ...]:
    from sysid_bench.excitation.export.damiao import MOTORS, damiao_drives

    if kind not in ("damiao", "can"):
        return ()
    if not motors:
        raise UsageError(
            f"Which motors drive {', '.join(joints)}? Name them in this order, as --motors "
            f"DM4340,DM4310,..., or in a TOML file; there are: {', '.join(MOTORS)}."
        )
    by_place = {str(k): name for k, name in enumerate(joints, 1)}
    numbered = set(motors) <= set(by_place) and not set(motors) & set(joints)
    if numbered and len(motors) != len(joints):
        raise UsageError(
            f"{len(motors)} motor(s) for {len(joints)} joints: {', '.join(joints)}; name one each."
        )
    return damiao_drives(
        joints, {by_place[k]: m for k, m in motors.items()} if numbered else motors
    )


def _geometry(brief: "DesignProblem", made: "Optimised") -> dict[str, Any]:
    if (made.clearance is None and made.floor is None) or brief.scene is None:
        return {"shapes": None, "ignored": [], "note": "collisions were not asked for"}
    scene = brief.scene(made.floor)
    note = (
        f"{scene.shapes} kept apart by {made.clearance or 0.0:g} m or more"
        if scene.shapes
        else "the robot's files hold none that can be read: nothing is known of collisions"
    )
    if scene.ignored:
        pairs = ", ".join(" and ".join(pair) for pair in scene.ignored)
        note += f"; not watched, for they touch in the reference configuration: {pairs}"
    return {"shapes": scene.shapes, "ignored": [list(p) for p in scene.ignored], "note": note}


def _recorded(
    file: Path, brief: "DesignProblem", joints: tuple[str, ...], made: "Optimised"
) -> "Trajectory":
    """A motion that has been recorded: columns t, <joint>.q, .v, .a, as a CSV export has them."""
    import numpy as np
    import pandas as pd

    from sysid_bench.types import Trajectory

    if not file.is_file():
        raise UsageError(f"There is no file {str(file)!r} of a recorded motion.")
    table = pd.read_csv(file)
    missing = [f"{j}.{key}" for j in joints for key in "qva" if f"{j}.{key}" not in table]
    if missing:
        raise UsageError(
            f"{file.name} has no columns {', '.join(missing)}; a recorded motion is a CSV as "
            "excite writes it."
        )
    space = made.space(brief)
    q = np.tile(brief.q0, (len(table), 1))
    v, a = np.zeros((2, len(table), sum(len(joint.dofs) for joint in brief.joints)))
    moving = space.moving_joints
    for array, places, key in ((q, space.places, "q"), (v, moving, "v"), (a, moving, "a")):
        array[:, places] = table[[f"{joint}.{key}" for joint in joints]].to_numpy()
    t = table["t"].to_numpy() if "t" in table else np.arange(len(table)) / brief.rate
    return brief.completed(Trajectory(t, q, v, a, file.name))


def _write(
    kind: str,
    out: Path,
    model: "RobotModel",
    motion: "Trajectory",
    joints: tuple[str, ...],
    drives: tuple[Any, ...],
    clamp: float,
    answer: dict[str, Any],
) -> list[str]:
    """Writes the motion; the answer tells what an export had to change. Warnings in words."""
    from sysid_bench.excitation.export import damiao, ros2
    from sysid_bench.excitation.export.commands import commands_of, csv_text
    from sysid_bench.excitation.information import torque_model

    where = {joint.name: joint for joint in model.joints}
    commands: Commands = commands_of(
        motion,
        torque_model(model).of(motion)[:, [model.torque_rows.index(name) for name in joints]],
        joints,
        [where[name].qadr for name in joints],
        [where[name].vadr for name in joints],
    )
    warnings = []
    if not commands.starts_at_rest:
        warnings.append(
            "the motion starts and ends in full swing; a motion for hardware should rest there: "
            f"--family {RESTING}"
        )
    if kind == "csv":
        text = csv_text(commands)
    elif kind == "ros2":
        text = (ros2.json_text if out.suffix == ".json" else ros2.yaml_text)(commands)
    else:
        commands, report = damiao.within_range(commands, drives, clamp)
        answer["export"] = [
            {**drive.to_json(), **entry} for drive, entry in zip(drives, report, strict=True)
        ]
        warnings += [
            f"{entry['joint']}: RMS torque {entry['rms_torque']:.3g} N m is above the rated "
            f"{entry['rated_torque']:.3g} N m of its motor"
            for entry in report
            if entry["hot"]
        ]
        if kind == "can":
            text = damiao.can_log(commands, drives)
        else:
            text = damiao.table_text(commands, drives, report)
    out.write_text(text, encoding="utf-8")
    return warnings


def motors_of(text: str) -> dict[str, dict[str, Any]]:
    """Motors of "DM4340,DM4310", in the order of the moving joints ("1", "2", ...), or of a TOML
    file with a table for each joint, and [all]."""
    import tomllib

    if not text.endswith(".toml"):
        return {str(k): {"motor": name.strip()} for k, name in enumerate(text.split(","), 1)}
    try:
        table = tomllib.loads(Path(text).read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise UsageError(f"There is no file {text!r} of motors.") from error
    except tomllib.TOMLDecodeError as error:
        raise UsageError(f"{text}: {error}.") from error
    if not all(isinstance(value, dict) for value in table.values()):
        raise UsageError(f"{text}: write a table for each joint: [joint1] motor = 'DM4340'.")
    return table


def parse_objective(text: str) -> str | dict[str, float]:
    """An objective's name, or the weights of "D=1,cond=0.2"."""
    if "=" not in text:
        return text
    return {name.strip(): _number(value) for name, value in _pairs(text.split(","))}


def parse_limits(words: Sequence[str]) -> dict[str, list[float]]:
    """The numbers of "v=1.7,1.7,2.2" and so on."""
    return {key: [_number(x) for x in values.split(",")] for key, values in _pairs(words)}


def parse_settings(given: Mapping[str, Any], boxes: Sequence[str]) -> dict[str, Any]:
    """Settings of the excitation from the words of options; what is not given is left out."""
    from sysid_bench.units import quantity

    units = {"period": "s", "clearance": "m", "floor": "m", "torque_share": "1"}
    chosen: dict[str, Any] = {
        key: quantity(value, units[key]) if key in units else value
        for key, value in given.items()
        if value is not None
    }
    if "joints" in chosen:
        chosen["joints"] = tuple(name.strip() for name in chosen["joints"].split(","))
    if boxes:
        chosen["boxes"] = {body: _box(body, ranges) for body, ranges in _pairs(boxes)}
    return chosen


def _box(body: str, text: str) -> list[list[float]]:
    ranges = [part.split(":") for part in text.split(",")]
    if [len(part) for part in ranges] != [2, 2, 2]:
        raise UsageError(f"The box of {body!r} is written x:x,y:y,z:z in m; got {text!r}.")
    return [[_number(low), _number(high)] for low, high in ranges]


def _pairs(words: Sequence[str]) -> list[tuple[str, str]]:
    pairs = [word.partition("=") for word in words]
    for key, sign, value in pairs:
        if not (key and sign and value):
            raise UsageError(f"{key + sign + value!r} is no pair; write NAME=VALUE.")
    return [(key.strip(), value) for key, _, value in pairs]


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError as error:
        raise UsageError(f"{text!r} is no number.") from error
