"""Tables and figures of a suite's [[paper]] entries, from the data that cells stored."""

from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, Final, TypeVar

from sysid_bench.commands.result import value_text
from sysid_bench.commands.run_folder import rerun_command, rows_with
from sysid_bench.errors import UsageError, reason_of
from sysid_bench.harness.cell import Cell, fields
from sysid_bench.harness.stored_run import RunFolder
from sysid_bench.harness.suite.expression import Expression
from sysid_bench.harness.suite.report_entries import DRAWN, Paper
from sysid_bench.input_files import parse_json, read_text
from sysid_bench.reporting.figures import DOUBLE
from sysid_bench.reporting.latex import Origin
from sysid_bench.reporting.signal_figures import (
    StoredCurves,
    StoredTorque,
    curve_figure,
    torque_figure,
)
from sysid_bench.reporting.text_table import TextTable, to_csv, to_json, to_latex, to_markdown
from sysid_bench.signals.log_readers.arrays import read_arrays
from sysid_bench.types import Array, Curve

Data = TypeVar("Data", StoredTorque, StoredCurves)

MOST_CURVES: Final = 40
"""Cells of a page with their torques, about 10 kB each."""
ROUNDING: Final = 1e-6
"""Change below which values count as those of a physical robot: solver tolerance."""


def paper_tables(run: RunFolder, name: str | None = None) -> tuple[TextTable, ...]:
    """Return the listings of a run (of one entry, or None: of all) whose cells are ok.

    Raises UsageError where a cell stored no data, or the reason instead.
    """
    made = []
    for entry, cell in _shown(run, drawn=False):
        if name in (None, entry.name):
            make = _model if entry.show == "model" else _base_parameters
            made.append(make(entry, cell, _stored(run, entry, cell)))
    return tuple(made)


def text_of(listing: TextTable, form: str, origin: Origin) -> str:
    """Return a listing as Markdown, CSV, LaTeX or JSON."""
    if form == "latex":
        return to_latex(listing, origin)
    return {"md": to_markdown, "csv": to_csv, "json": to_json}[form](listing)


def write_paper_figures(run: RunFolder, folder: Path) -> list[tuple[str, Path]]:
    """Draw the figures of [[paper]] entries as .pdf and .svg; return title and path of the
    latter."""
    files = []
    for name, sample in paper_figures(run):
        drawing = folder / f"{name}.svg"
        for path in (drawing.with_suffix(".pdf"), drawing):
            write_paper_figure(sample, path)
        files.append((sample.title, drawing))
    return files


def write_paper_figure(
    sample: StoredTorque | StoredCurves, path: Path, width: float = DOUBLE
) -> Path:
    """Draw torques or curves (width in inches) into a .pdf, .png or .svg file."""
    if isinstance(sample, StoredCurves):
        return curve_figure.write(path, sample, width)
    return torque_figure.write(path, sample, width)


def paper_figures(run: RunFolder) -> Iterator[tuple[str, StoredTorque | StoredCurves]]:
    """Yield name and data of the figures of [[paper]] entries whose cells are ok.

    Raises UsageError where a cell stored no data, or the reason instead.
    """
    for entry, cell in _shown(run, drawn=True):
        data = _file(run, entry, cell, "npz")
        if not data.is_file():
            _stored(run, entry, cell)  # raises with the reason
        title = f"{entry.title or entry.name}: {_source(cell)}"
        is_torque = entry.show == "torques"
        yield (
            entry.name,
            (_read(_torques, data, title) if is_torque else _read(_curves, data, title)),
        )


def torque_samples(run: RunFolder) -> dict[str, StoredTorque]:
    """Return the torques along a test log of the first `MOST_CURVES` cells that stored them, by
    cell id."""
    shown = [entry for entry in run.suite.paper if entry.show == "torques"]
    titles = {entry.name: entry.title or entry.name for entry in shown}
    files = sorted((run.path / "artifacts").glob("*/paper/*.npz"))
    # Reversed: of several figures of a cell the first by name stays.
    found = {file.parent.parent.name: file for file in reversed(files) if file.stem in titles}
    return {
        cell: _read(_torques, found[cell], titles[found[cell].stem])
        for cell in sorted(found)[:MOST_CURVES]
    }


def _read(make: Callable[[str, Mapping[str, Array]], Data], data: Path, title: str) -> Data:
    """Make torques or curves of a stored file; raise UsageError where it cannot be read."""
    try:
        return make(title, read_arrays(data))
    except Exception as error:  # NumPy and zipfile raise many types on damaged files
        raise UsageError(
            f"{data} cannot be read ({reason_of(error)}); run its cell again (--rerun all)."
        ) from error


def _torques(title: str, arrays: Mapping[str, Array]) -> StoredTorque:
    rows, units = (tuple(arrays[key].tolist()) for key in ("rows", "units"))
    return StoredTorque(title, arrays["t"], arrays["measured"], arrays["predicted"], rows, units)


def _curves(title: str, arrays: Mapping[str, Array]) -> StoredCurves:
    curves = []
    for k, name in enumerate(arrays["curves"]):
        series = dict(zip(arrays[f"series{k}"].tolist(), arrays[f"values{k}"], strict=True))
        low, high = arrays["limits"][k].tolist()
        limits = None if low != low else (low, high)  # stored as not a number
        unit = str(arrays["units"][k])
        curves.append(Curve(str(name), arrays[f"t{k}"], series, unit, limits))
    return StoredCurves(title, tuple(curves))


def _shown(run: RunFolder, drawn: bool) -> Iterator[tuple[Paper, Cell]]:
    """Figures or listings of a suite, each with its first cell whose row is ok."""
    for entry in run.suite.paper:
        if (entry.show in DRAWN) != drawn:
            continue
        found = run.plan.cells
        if entry.select is not None:
            # On the fields of cells and, where there is one, on their row.
            wanted = Expression.parse(entry.select)
            met = rows_with(run, wanted)
            found = tuple(
                c for c in found if (met[c.id] if c.id in met else wanted.holds(fields(c)))
            )
        if not found:
            raise UsageError(f"[[paper]] {entry.name!r}: no cell meets {entry.select!r}.")
        rows = run.first_fields().rows
        ok = [cell for cell in found if rows.get(cell.id, {}).get("status") == "ok"]
        if ok:
            yield entry, ok[0]


def _file(run: RunFolder, entry: Paper, cell: Cell, kind: str) -> Path:
    return run.path / "artifacts" / cell.id / "paper" / f"{entry.name}.{kind}"


def _stored(run: RunFolder, entry: Paper, cell: Cell) -> dict[str, Any]:
    """The JSON data of an entry; raises UsageError where there is only a reason, or nothing."""
    path = _file(run, entry, cell, "json")
    again = rerun_command(run.path, cell.id)
    if not path.is_file():
        raise UsageError(
            f"[[paper]] {entry.name!r}: the cell {cell.id} has stored no data for it; run it again "
            f"with: {again}"
        )
    try:
        content: dict[str, Any] = dict(parse_json(read_text(path)))
    except (OSError, ValueError, TypeError) as error:
        raise UsageError(
            f"{path} cannot be read ({error}); run the cell again with: {again}"
        ) from error
    if "error" in content:
        raise UsageError(f"[[paper]] {entry.name!r}: {content['error']}")
    return content


def _base_parameters(entry: Paper, cell: Cell, data: Mapping[str, Any]) -> TextTable:
    """The sums in the order of the robot's manifest, with the values of a cell."""
    rows = tuple(
        (str(k), row["expression"], value_text(row["value"]), row["impossible"] or "")
        for k, row in enumerate(data["rows"], start=1)
    )
    notes = [_source(cell)]
    extra = [f"{name} = {value_text(value)}" for name, value in data["extra"].items()]
    if extra:
        notes.append(f"Besides: {', '.join(extra)}.")
    change = data["smallest_change"] or 0.0
    if change > ROUNDING:
        zero = data["zero"]
        no = f"With {', '.join(zero)} taken for zero, no" if zero else "No"
        notes.append(f"{no} robot has them: some have to change by {change:.3g} or more.")
    title = entry.title or f"Base parameters of {cell.labels['robot']}"
    return TextTable(
        entry.name, title, ("no.", "parameter", "value", "impossible"), rows, tuple(notes)
    )


def _model(entry: Paper, cell: Cell, data: Mapping[str, Any]) -> TextTable:
    """The kinematic table where the robot has one, else its joints."""
    lengths = ", ".join(f"{name} = {value:g} m" for name, value in data["lengths"].items())
    title = entry.title or f"Model of {data['robot']}"
    rows = tuple(map(tuple, data["rows"]))
    return TextTable(entry.name, title, tuple(data["head"]), rows, (lengths,) if lengths else ())


def _source(cell: Cell) -> str:
    words = cell.labels
    return (
        f"{words['excitation']}, {words['signals']}, {words['estimator']}; terms {words['terms']}."
    )
