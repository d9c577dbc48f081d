"""One cell as a Rerun recording: the moving robot, its torques, residuals, regressor and a summary.

Imported when a recording is written: loading rerun takes 0.6 s.
"""

import colorsys
import os
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from sysid_bench.errors import UsageError
from sysid_bench.metrics import METRICS
from sysid_bench.reporting.scene import RecordingScene, log_scene, scene_of
from sysid_bench.reporting.selection import label
from sysid_bench.reporting.signal_figures import difference_figure
from sysid_bench.reporting.writers import markdown_text, table_line
from sysid_bench.types import CellData

_PLOTS_PER_PAGE = 9


def recording_layout(cell: CellData, timeline: str, rows: Sequence[str]) -> rrb.Blueprint:
    """Robot and summary to the left; one torque plot per joint, residuals, regressor right.

    `rows` name the torques.
    """
    eye = None if cell.positions is None or cell.positions.size == 0 else _eye(cell.positions)
    shown = ["/robot/**", "/sticks/**"]
    left = rrb.Vertical(
        rrb.Spatial3DView(name="Robot", origin="/", contents=shown, eye_controls=eye),
        rrb.TextDocumentView(name="Summary", origin="/summary"),
        row_shares=[3, 2],
    )
    torques = _torque_page(rows)
    parts: list[rrb.Container | rrb.View] = [
        # Curves of an on-line estimator stand behind a tab.
        rrb.Tabs(torques, _curve_page(cell)) if cell.curves else torques
    ]
    if cell.predicted is not None:
        parts.append(rrb.TimeSeriesView(name="Residual, measured - predicted", origin="/residual"))
    # Singular values and gap side by side, as far as the cell has them.
    views: list[rrb.View] = []
    if len(cell.singular_values):
        views.append(rrb.BarChartView(name="log10 singular values", origin="/singular_values"))
    if cell.gap_map.size:
        views.append(rrb.Spatial2DView(name="log10 |Y - Y_pin|", origin="/gap_map"))
    if views:
        parts.append(rrb.Horizontal(*views, column_shares=[1, 3][-len(views) :]))
    right = rrb.Vertical(*parts, row_shares=[3] + [1] * (len(parts) - 1))
    return rrb.Blueprint(
        rrb.Horizontal(left, right, column_shares=[2, 3]),
        rrb.BlueprintPanel(state="hidden"),
        rrb.SelectionPanel(state="hidden"),
        rrb.TimePanel(state="collapsed", timeline=timeline),
        auto_views=False,
    )


def _torque_page(rows: Sequence[str]) -> rrb.Container:
    """A grid of joints; beyond nine, tabs of grids."""
    plots = [
        rrb.TimeSeriesView(
            name=row,
            origin=rr.new_entity_path(["torque", row]),
            plot_legend=rrb.PlotLegend(visible=i == 0),  # one legend serves all plots
        )
        for i, row in enumerate(rows)
    ]
    starts = range(0, len(plots), _PLOTS_PER_PAGE)
    grids = [
        _grid(plots[start : start + _PLOTS_PER_PAGE], f"Torques {i}")
        for i, start in enumerate(starts, start=1)
    ]
    return grids[0] if len(grids) == 1 else rrb.Tabs(*grids, name="Torques")


def _eye(positions: np.ndarray) -> rrb.EyeControls3D:
    """View of all places that the bodies' origins (N, bodies, 3) reach."""
    corners = positions.reshape(-1, 3)
    low, high = corners.min(axis=0), corners.max(axis=0)
    centre, size = (low + high) / 2, max(float(np.linalg.norm(high - low)), 0.2)
    # From the front right and a little above, far enough for links beyond the last origin.
    offset = size * np.array([0.9, -0.9, 0.5])
    return rrb.EyeControls3D(position=centre + offset, look_target=centre)


def _curve_page(cell: CellData) -> rrb.Container:
    plots = [
        rrb.TimeSeriesView(name=curve.name, origin=rr.new_entity_path(["curves", curve.name]))
        for curve in cell.curves
    ]
    return _grid(plots, "On-line")


def _grid(plots: Sequence[rrb.View], name: str) -> rrb.Container:
    # One column up to three plots, two up to six: time axes are to stay long.
    return rrb.Grid(*plots, grid_columns=min((len(plots) + 2) // 3, 3), name=name)


_IDENTITY = (
    "robot", "payload", "task", "plant", "excitation", "simulation", "noise", "pipeline",
    "estimator",
)  # fmt: skip


def summary(data: CellData, complaints: Sequence[str] = ()) -> str:
    """Markdown of the settings, scores and base parameters of a cell, and of `complaints`."""
    settings = [(name, data.row[name]) for name in _IDENTITY if data.row.get(name) is not None]
    settings.append(("status", data.row.get("status") or "unknown"))
    settings += [(name, data.row[name]) for name in ("reason", "stop") if data.row.get(name)]
    parts = [
        f"# {markdown_text(label(data.row.get('robot', 'Cell')))}",
        _table(("", ""), settings),
        *_scores(data.row),
        *_parameters(data),
        *(f"Not drawn: {markdown_text(text)}" for text in complaints),
    ]
    return "\n\n".join(parts) + "\n"


def _scores(row: Mapping[str, Any]) -> Iterator[str]:
    values = [(m, row.get(m.name)) for m in METRICS.values() if m.shown and m.name != "seconds"]
    scores = [(metric.heading, value) for metric, value in values if value is not None]
    if scores:
        yield _table(("score", "value"), scores)


def _parameters(data: CellData) -> Iterator[str]:
    """The base parameters that were estimated, each with its standard deviation where known."""
    estimate, base = data.estimate, data.base
    if estimate is None or estimate.beta is None or base is None:
        return
    std: Iterable[Any] = [""] * base.rank
    if estimate.covariance is not None:
        # Rounding can make the variance of an exactly known parameter negative.
        std = np.sqrt(np.maximum(np.diag(estimate.covariance), 0.0))
    yield f"## Base parameters: {base.rank} of {len(base.parameters)} unknowns"
    rows = list(zip(base.names, estimate.beta, std, strict=True))
    yield _table(("pivot of the combination (SI)", "estimate", "std"), rows)


def _table(head: Sequence[str], rows: Sequence[Sequence[Any]]) -> str:
    body = (map(_cell, row) for row in rows)
    return "\n".join(map(table_line, [head, ["---"] * len(head), *body]))


def _cell(value: Any) -> str:
    return markdown_text(
        f"{value:.4g}" if isinstance(value, (float, np.floating)) else label(value)
    )


TIMELINE: Final = "sim_time"
_MEASURED, _PREDICTED = (59, 130, 246), (234, 120, 30)
_FIRST: Final = (
    (0, 114, 178), (213, 94, 0), (0, 158, 115), (204, 121, 167), (86, 180, 233), (230, 159, 0),
)  # fmt: skip
_SMALLEST_RATIO = 1e-20  # of the largest: zeros stay on the logarithmic picture


def record(cell: CellData, path: Path, max_hz: float = 50) -> Path:
    """Write the recording of a cell to a temporary file and rename it; seconds on `sim_time`.

    Samples are thinned to at most `max_hz`: pictures need no more, full rates are for data files.
    Raises UsageError where `max_hz` is not positive or the signals differ in length.
    """
    picked = _thinned(cell, max_hz)
    scene = scene_of(cell)
    part = path.with_name(path.name + ".part")
    row = cell.row
    # The viewer keeps one layout per application: robots differ in joints, so each has its name.
    application = re.sub(r"[^\w .-]", "-", f"sysid_bench {row.get('robot', '')}".strip())
    stream = rr.RecordingStream(application, recording_id=str(row.get("id", path.stem)))
    try:
        layout = recording_layout(cell, TIMELINE, _row_names(cell))
        stream.save(part, default_blueprint=layout)
        _log(stream, scene, picked)
        stream.flush()
        stream.disconnect()  # writes the footer that `rerun rrd verify` asks for
        os.replace(part, path)
    finally:
        part.unlink(missing_ok=True)
    return path


def _thinned(cell: CellData, max_hz: float) -> np.ndarray:
    """Indices of the samples to keep: every k-th, evenly, the first among them."""
    if not max_hz > 0:
        raise UsageError(f"max_hz is {max_hz!r}; give a positive number of hertz.")
    times, count = cell.motion.t, len(cell.motion)
    for name in ("measured", "predicted", "positions", "quaternions"):
        signal = getattr(cell, name)
        if signal is not None and len(signal) != count:
            raise UsageError(f"{name} has {len(signal)} samples, the motion {count}: align them.")
    if count < 2:
        return np.arange(count)
    rate = (count - 1) / (times[-1] - times[0])
    # Rounding of the rate must not drop every second sample of a motion at exactly max_hz.
    return np.arange(0, count, max(int(np.ceil(rate / max_hz - 1e-9)), 1))


def _log(stream: rr.RecordingStream, scene: RecordingScene, picked: np.ndarray) -> None:
    cell = scene.cell
    times = rr.TimeColumn(TIMELINE, duration=cell.motion.t[picked])
    log_scene(stream, scene, picked, times)
    # Position and velocity of hinges and slides: with the torques, the file is a log.
    for i, (joint, (q, v)) in enumerate(cell.joints.items()):
        for word, values in (("position", cell.motion.q[:, q]), ("velocity", cell.motion.v[:, v])):
            _log_series(stream, [word, joint], joint, _joint_colour(i), values[picked], times)
    _log_torques(stream, cell, picked, times)
    # On-line estimates, each curve over its own times.
    for curve in cell.curves:
        over = rr.TimeColumn(TIMELINE, duration=curve.t)
        for i, (name, values) in enumerate(curve.series.items()):
            _log_series(stream, ["curves", curve.name, name], name, _joint_colour(i), values, over)
    # Singular values and the gap to Pinocchio span many decades: logarithms of both.
    if len(cell.singular_values):
        bars = rr.BarChart(_log10(cell.singular_values), color=_MEASURED)
        stream.log("singular_values", bars, static=True)
    if cell.gap_map.size:
        image = rr.Tensor(_log10(cell.gap_map), dim_names=("row", "parameter"))
        stream.log("gap", image, static=True)
        picture = rr.EncodedImage(contents=difference_figure(cell), media_type="image/png")
        stream.log("gap_map", picture, static=True)
    text = rr.TextDocument(summary(cell, scene.complaints), media_type="text/markdown")
    stream.log("summary", text, static=True)
    names = ("id", "robot", "payload", "task", "estimator", "status")
    known = {name: str(cell.row[name]) for name in names if name in cell.row}
    stream.send_property("sysid", rr.AnyValues(drop_untyped_nones=True, **known))


def _log_torques(
    stream: rr.RecordingStream, cell: CellData, picked: np.ndarray, times: rr.TimeColumn
) -> None:
    """Measured and predicted torque of every row, and their difference."""
    for i, row in enumerate(_row_names(cell)):
        measured = cell.measured[picked, i]
        _log_series(stream, ["torque", row, "measured"], "measured", _MEASURED, measured, times)
        if cell.predicted is None:
            continue
        predicted = cell.predicted[picked, i]
        residual = measured - predicted
        _log_series(stream, ["torque", row, "predicted"], "predicted", _PREDICTED, predicted, times)
        _log_series(stream, ["residual", row], row, _joint_colour(i), residual, times)


def _log_series(
    stream: rr.RecordingStream, parts: list[str], name: str, colour: tuple[int, int, int],
    values: np.ndarray, times: rr.TimeColumn,
) -> None:  # fmt: skip
    path = rr.new_entity_path(parts)
    stream.log(path, rr.SeriesLines(names=name, colors=[colour], widths=[1.5]), static=True)
    stream.send_columns(path, indexes=[times], columns=rr.Scalars.columns(scalars=values))


def _log10(values: np.ndarray) -> np.ndarray:
    """log10 of sizes (any shape); what is zero or not a number lies at the floor."""
    sizes = np.nan_to_num(np.abs(np.asarray(values, dtype=float)), nan=0.0, posinf=0.0)
    floor = max(sizes.max(initial=0.0) * _SMALLEST_RATIO, np.finfo(float).tiny)
    return np.asarray(np.log10(np.maximum(sizes, floor)))


def _row_names(cell: CellData) -> list[str]:
    return [name or f"row{i}" for i, name in enumerate(cell.rows)]


def _joint_colour(i: int) -> tuple[int, int, int]:
    """Colours that differ: those of Okabe and Ito, then hues 53 degrees apart in three strengths:
    40 joints differ by 40 of 765 levels."""
    if i < len(_FIRST):
        return _FIRST[i]
    saturation, value = ((0.85, 0.95), (0.5, 0.9), (0.65, 0.7))[i % 3]
    r, g, b = colorsys.hsv_to_rgb((0.1 + 0.146 * i) % 1.0, saturation, value)
    return round(255 * r), round(255 * g), round(255 * b)
