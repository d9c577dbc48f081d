"""Layout of a recording in the Rerun viewer. Loads Rerun, which takes a moment."""

from collections.abc import Iterator, Sequence

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from sysid_bench.types import CellData

_PLOTS_PER_PAGE = 9


def recording_layout(cell: CellData, timeline: str, rows: Sequence[str]) -> rrb.Blueprint:
    """Robot and summary to the left; one torque plot per joint, residuals, regressor right.

    `rows` name the torques.
    """
    about = rrb.TextDocumentView(name="Summary", origin="/summary")
    left = rrb.Vertical(_robot_view(cell), about, row_shares=[3, 2])
    parts: list[rrb.Container | rrb.View] = [
        _time_pages(cell, rows),
        *_residual_views(cell),
        *_regressor_views(cell),
    ]
    right = rrb.Vertical(*parts, row_shares=[3] + [1] * (len(parts) - 1))
    return rrb.Blueprint(
        rrb.Horizontal(left, right, column_shares=[2, 3]),
        rrb.BlueprintPanel(state="hidden"),
        rrb.SelectionPanel(state="hidden"),
        rrb.TimePanel(state="collapsed", timeline=timeline),
        auto_views=False,
    )


def _time_pages(cell: CellData, rows: Sequence[str]) -> rrb.Container:
    """The torques and, of an on-line estimator, its curves behind a tab."""
    torques = _torque_pages(rows)
    return rrb.Tabs(torques, _curve_page(cell)) if cell.curves else torques


def _residual_views(cell: CellData) -> Iterator[rrb.View]:
    if cell.predicted is not None:
        yield rrb.TimeSeriesView(name="Residual, measured - predicted", origin="/residual")


def _regressor_views(cell: CellData) -> Iterator[rrb.Container]:
    """Singular values and gap side by side, as far as the cell has them."""
    views: list[rrb.View] = []
    if len(cell.singular_values):
        views.append(rrb.BarChartView(name="log10 singular values", origin="/singular_values"))
    if cell.gap_map.size:
        views.append(rrb.Spatial2DView(name="log10 |Y - Y_pin|", origin="/gap_map"))
    if views:
        yield rrb.Horizontal(*views, column_shares=[1, 3][-len(views) :])


def _robot_view(cell: CellData) -> rrb.View:
    eye = None if cell.positions is None or cell.positions.size == 0 else _eye(cell.positions)
    return rrb.Spatial3DView(
        name="Robot", origin="/", contents=["/robot/**", "/sticks/**"], eye_controls=eye
    )


def _eye(positions: np.ndarray) -> rrb.EyeControls3D:
    """View of all places that the bodies' origins (N, bodies, 3) reach."""
    corners = positions.reshape(-1, 3)
    low, high = corners.min(axis=0), corners.max(axis=0)
    centre, size = (low + high) / 2, max(float(np.linalg.norm(high - low)), 0.2)
    # From the front right and a little above, far enough for links beyond the last origin.
    offset = size * np.array([0.9, -0.9, 0.5])
    return rrb.EyeControls3D(position=centre + offset, look_target=centre)


def _torque_pages(rows: Sequence[str]) -> rrb.Container:
    """A grid of joints; beyond nine, tabs of grids."""
    plots = [_torque_plot(row, has_legend=i == 0) for i, row in enumerate(rows)]
    starts = range(0, len(plots), _PLOTS_PER_PAGE)
    grids = [
        _grid(plots[start : start + _PLOTS_PER_PAGE], f"Torques {i}")
        for i, start in enumerate(starts, start=1)
    ]
    return grids[0] if len(grids) == 1 else rrb.Tabs(*grids, name="Torques")


def _torque_plot(row: str, has_legend: bool) -> rrb.View:
    legend = rrb.PlotLegend(visible=has_legend)
    return rrb.TimeSeriesView(
        name=row, origin=rr.new_entity_path(["torque", row]), plot_legend=legend
    )


def _curve_page(cell: CellData) -> rrb.Container:
    plots = [
        rrb.TimeSeriesView(name=curve.name, origin=rr.new_entity_path(["curves", curve.name]))
        for curve in cell.curves
    ]
    return _grid(plots, "On-line")


def _grid(plots: Sequence[rrb.View], name: str) -> rrb.Container:
    # One column up to three plots, two up to six: time axes are to stay long.
    return rrb.Grid(*plots, grid_columns=min((len(plots) + 2) // 3, 3), name=name)
