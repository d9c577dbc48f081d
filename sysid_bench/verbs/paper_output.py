"""What a suite's [[paper]] asks for: the model, its base parameters with values, measured and
predicted torques, as papers print them."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

from sysid_bench.errors import UsageError
from sysid_bench.reporting.listing import Listing, to_csv, to_latex, to_markdown

if TYPE_CHECKING:
    from sysid_bench.experiments.prepared import Prepared
    from sysid_bench.experiments.recorded.source import RecordedSource
    from sysid_bench.harness.plan import Cell
    from sysid_bench.harness.store import RunFolder
    from sysid_bench.harness.suite.model import Paper
    from sysid_bench.reporting.latex import Origin
    from sysid_bench.types import Array, Estimate


def paper_outputs(run: "RunFolder", name: str | None = None) -> tuple[Listing, ...]:
    """The listings of a run (None: all), of cells that have a row; a cell is executed again for its
    values."""
    asked = [entry for entry in run.suite.paper if entry.show != "torques"]
    asked = [entry for entry in asked if name in (None, entry.name)]
    made = []
    for entry in asked:
        cell = _cell(run, entry)
        if cell is not None:
            make = _model if entry.show == "model" else _base_parameters
            made.append(make(run, entry, cell))
    return tuple(made)


def draw_papers(run: "RunFolder", folder: Path) -> list[tuple[str, Path]]:
    """The torque figures of a run as .pdf and .svg: title and path of the latter."""
    asked = [entry for entry in run.suite.paper if entry.show == "torques"]
    if not asked:
        return []
    from sysid_bench.experiments.recorded.source import predict_log
    from sysid_bench.reporting.torque_figure import torque_figure

    files = []
    for entry in asked:
        cell = _cell(run, entry)
        if cell is None:
            continue
        posed, estimate = _again(run, entry, cell)
        beta = _beta(entry, estimate)
        found = predict_log(posed, beta, entry.test)
        problem = found.problem
        units = [kind.removeprefix("joint ") for kind in problem.kinds]
        for kind in ("pdf", "svg"):
            path = folder / f"{entry.name}.{kind}"
            torque_figure(path, found.t, problem.rows, found.measured, found.predicted, units)
        files.append((f"{entry.title or entry.name}: {_source(cell)}", path))
    return files


def text_of(listing: Listing, form: str, origin: "Origin") -> str:
    """Markdown, CSV or LaTeX of a listing."""
    if form == "md":
        return to_markdown(listing)
    return to_csv(listing) if form == "csv" else to_latex(listing, origin)


def _cell(run: "RunFolder", entry: "Paper") -> "Cell | None":
    """The first cell with a sound row that an entry selects."""
    from sysid_bench.harness.plan import fields
    from sysid_bench.harness.suite.expression import Expression

    rows = run.rows().rows
    wanted = None if entry.select is None else Expression.parse(entry.select)
    found = [c for c in run.plan.cells if wanted is None or wanted.matches(
        {**rows.get(c.id, {}), **fields(c)})]  # fmt: skip
    if not found:
        raise UsageError(f"[[paper]] {entry.name!r}: no cell meets {entry.select!r}.")
    return next((cell for cell in found if rows.get(cell.id, {}).get("status") == "ok"), None)


def _again(
    run: "RunFolder", entry: "Paper", cell: "Cell"
) -> "tuple[Prepared[RecordedSource], Estimate]":
    """The cell's problem and estimate."""
    from sysid_bench.experiments.recorded.prepare import prepare_recorded
    from sysid_bench.experiments.robot_cache import cached_robot
    from sysid_bench.identification.identify import identify
    from sysid_bench.naming import build, resolve_paths

    if cell.spec.log is None:
        raise UsageError(
            f"[[paper]] {entry.name!r} shows {entry.show} of recordings; select a cell of a "
            "[[log]]."
        )
    suite = run.suite
    robots = None if suite.robots_dir is None else str(suite.robots_dir)
    spec = cell.spec
    robot = cached_robot(spec.robot, spec.payload, robots, str(suite.folder), spec.free_base)
    posed = prepare_recorded(spec, robot)
    method = build("estimator", resolve_paths(cell.estimator, suite.folder))
    return posed, identify(method, posed.problem, posed.experiment)


def _beta(entry: "Paper", estimate: "Estimate") -> "Array":
    if estimate.status != "ok" or estimate.beta is None:
        raise UsageError(f"[[paper]] {entry.name!r}: {estimate.reason}")
    return estimate.beta


def _base_parameters(run: "RunFolder", entry: "Paper", cell: "Cell") -> Listing:
    """The sums as the robot's manifest orders them, with the values of a cell."""
    from sysid_bench.evaluation.covariance import standard_errors
    from sysid_bench.verbs.base_table import paper_table
    from sysid_bench.verbs.estimate_fields import base_of

    posed, estimate = _again(run, entry, cell)
    _beta(entry, estimate)
    values = {"base": base_of(estimate, posed.problem, standard_errors(posed.problem, estimate))}
    ask = posed.source.builder.unknowns
    table = paper_table(cell.spec.robot, ask.terms, None, values, run.suite.robots_dir)
    rows = tuple(
        (
            str(k),
            row["expression"],
            _number(row["value"]),
            row["impossible"] or "",
        )
        for k, row in enumerate(table["rows"], start=1)
    )
    beside = [
        f"{name} = {_number(value)}"
        for name, value in zip(posed.problem.base.names, estimate.beta, strict=True)  # type: ignore[arg-type]
        if name in ask.extra
    ]
    notes = [_source(cell)]
    notes += [f"Beside them: {', '.join(beside)}."] if beside else []
    change = table["smallest_change"]
    if change is not None and change > 1e-6:
        zero = f"With {', '.join(table['zero'])} taken for zero, no" if table["zero"] else "No"
        notes.append(f"{zero} robot has them: some have to change by {change:.3g} or more.")
    title = entry.title or f"Base parameters of {cell.labels['robot']}"
    return Listing(
        entry.name, title, ("no.", "parameter", "value", "impossible"), rows, tuple(notes)
    )


def _model(run: "RunFolder", entry: "Paper", cell: "Cell") -> Listing:
    """The kinematic table where the robot has one, else its joints."""
    from sysid_bench.models.dh.dh_table import printed_table
    from sysid_bench.models.load import load_robot
    from sysid_bench.models.manifest import find_manifest

    manifest = find_manifest(cell.spec.robot, run.suite.robots_dir, run.suite.folder)
    title = entry.title or f"Model of {manifest.name}"
    if manifest.dh is not None and manifest.manifest_file is not None:
        head, rows, lengths = printed_table(manifest.manifest_file.parent / manifest.dh.table)
        told = ", ".join(f"{name} = {value:g} m" for name, value in lengths.items())
        return Listing(entry.name, title, head, rows, (told,) if told else ())
    robot = load_robot(manifest)
    rows = tuple(
        (joint.name, joint.kind, *_range(robot.limits, joint.vadr)) for joint in robot.joints
    )
    return Listing(entry.name, title, ("joint", "kind", "from", "to"), rows)


def _range(limits: Any, dof: int) -> tuple[str, str]:
    return f"{limits.q_low[dof]:.4g}", f"{limits.q_high[dof]:.4g}"


def _source(cell: "Cell") -> str:
    told = cell.labels
    return f"{told['excitation']}, {told['signals']}, {told['estimator']}; terms {told['terms']}."


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.4g}"
