"""Figures of a ranking: profiles, and error against CPU time."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

from sysid_bench.reporting.figures import COLOURS, WIDTH, Drawing, new_figure, plain
from sysid_bench.reporting.ranking import RATIOS, Ranking
from sysid_bench.reporting.selection import label

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure


NAMED: Final = len(COLOURS)
"""Methods that have a colour and a name, the first of the order; the others are grey."""

_DASHES: Final = ("-", "--")


@Drawing
def profile(ranking: Ranking, width: float = WIDTH) -> "Figure":
    """Draw the profiles of a ranking."""
    drawing = new_figure(2.6, width)
    axes = drawing.add_subplot()
    for rank in reversed(range(len(ranking.method_names))):  # the first on top
        share, name = ranking.profile[:, rank], plain(ranking.method_names[rank])
        style: dict[str, Any]
        if rank < NAMED:
            style = {"color": COLOURS[rank], "linestyle": _DASHES[rank % 2], "label": name}
        else:  # one of the grey lines names them all
            style = {"color": "#cccccc", "linewidth": 0.5}
            style["label"] = "others" if rank == NAMED else None
        axes.step(RATIOS, share, where="post", **style)
    axes.set_xscale("log")
    axes.set_xlim(RATIOS[0], RATIOS[-1])
    axes.set_ylim(-0.01, 1.01)
    ticks = [0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 50, 100]
    axes.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
    axes.minorticks_off()
    axes.set_xlabel(plain(f"Times {ranking.against}: {ranking.metric.title.lower()}"))
    axes.set_ylabel("Share of cases within")
    axes.grid(which="major", color="#dddddd", linewidth=0.4)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    handles, names = axes.get_legend_handles_labels()
    drawing.legend(handles[::-1], names[::-1], loc="outside right upper", frameon=False,
                   handlelength=1.6, handletextpad=0.4, borderaxespad=0.2)  # fmt: skip
    return drawing


_SECONDS: Final = "seconds_cpu"
_WIDE: Final = 10.0
"""Ratio of the largest error to the smallest from which on the axis is logarithmic."""
_FEW: Final = 100.0
"""Ratio of the longest time to the shortest below which decades alone are too few ticks."""
_MARKERS: Final = ("o", "s", "D", "^", "v", "P", "X")


@dataclass(frozen=True)
class CostPoint:
    """A method: median CPU time (s) of its ok cells, and its error over that of the reference with
    the interval (None for few robots)."""

    method: str
    seconds: float
    ratio: float
    interval: tuple[float, float] | None


def method_times(cells: "pd.DataFrame") -> Mapping[str, float]:
    """Median CPU time (s) of the ok cells of each method that has times."""
    if not {_SECONDS, "estimator", "status"} <= set(cells.columns):
        return {}
    timed = cells[(cells["status"] == "ok") & cells[_SECONDS].notna()]
    medians = timed[_SECONDS].astype(float).groupby(timed["estimator"].map(label)).median()
    return {str(name): float(value) for name, value in medians.items()}


def cost_by_method(ranking: Ranking, cells: "pd.DataFrame") -> tuple[CostPoint, ...]:
    """The methods of a ranking that have a ratio and a time, in its order; a failure counts as the
    answer of the reference."""
    seconds, points = method_times(cells), []
    for one in ranking.comparisons:
        ratio = one.fallback
        if ratio.value is not None and seconds.get(one.method, 0.0) > 0:
            ends = None if ratio.low is None or ratio.high is None else (ratio.low, ratio.high)
            # With the reference in place of failures: else a method would look good on the cases
            # that it managed.
            points.append(CostPoint(one.method, seconds[one.method], ratio.value, ends))
    return tuple(points)


def find_best(points: tuple[CostPoint, ...]) -> tuple[CostPoint, ...]:
    """The points than which no other is both quicker and better, from the quickest on."""
    kept: list[CostPoint] = []
    # From the quickest on, only a better ratio joins the front.
    for point in sorted(points, key=lambda one: (one.seconds, one.ratio)):
        if not kept or point.ratio < kept[-1].ratio:
            kept.append(point)
    return tuple(kept)


@Drawing
def cost_figure(ranking: Ranking, cells: "pd.DataFrame", width: float = WIDTH) -> "Figure":
    """Draw error against CPU time; a ranking without times has no points."""
    drawing, points = new_figure(2.6, width), cost_by_method(ranking, cells)
    axes = drawing.add_subplot()
    front = find_best(points)
    axes.step([p.seconds for p in front], [p.ratio for p in front], where="post",
              color="#bbbbbb", linewidth=0.8, zorder=0)  # fmt: skip
    for place, point in enumerate(points):
        # The colour of its rank; methods behind the last colour share one grey name.
        is_named = place < NAMED
        colour, marker = (COLOURS[place], _MARKERS[place]) if is_named else ("#999999", "o")
        name = plain(point.method) if is_named else "others" if place == NAMED else None
        if point.interval is not None:
            axes.plot([point.seconds] * 2, point.interval, color=colour, linewidth=0.6)
        axes.plot([point.seconds], [point.ratio], marker, color=colour, markeredgewidth=0,
                  label=name)  # fmt: skip
    axes.set_xscale("log")
    ratios, seconds = [point.ratio for point in points], [point.seconds for point in points]
    axes.set_yscale("log" if max(ratios) > _WIDE * min(ratios) else "linear")
    axes.minorticks_off()
    if max(seconds) < _FEW * min(seconds):
        ticks = {f"{tick:.2g}": tick for tick in _time_ticks(seconds)}
        axes.set_xticks(list(ticks.values()), list(ticks))
    axes.set_xlabel("CPU time of an answer (s), median")
    axes.set_ylabel(plain(f"Error, times {ranking.against}"))
    axes.grid(which="major", color="#dddddd", linewidth=0.4)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    drawing.legend(loc="outside right upper", frameon=False, handletextpad=0.2, borderaxespad=0.2)
    return drawing


def _time_ticks(seconds: Sequence[float]) -> list[float]:
    """Return times at 1, 2 and 5 of the decades that the times (s) span, or their ends where these
    are fewer than two."""
    low, high = min(seconds), max(seconds)
    decades = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    ticks = [m * 10.0**k for k in decades for m in (1, 2, 5) if low <= m * 10.0**k <= high]
    return ticks if len(ticks) > 1 else sorted({low, high})
