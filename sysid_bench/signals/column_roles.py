"""Roles of the columns of a recording without names, by their numbers: derivatives of one another,
torques that the model predicts along the motion, stamps that rise and temperatures that drift."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import groupby, product
from typing import Final

import numpy as np

from sysid_bench.models.robot import RobotModel
from sysid_bench.signals.log_checks import check_finite
from sysid_bench.signals.torque_scale import FOLLOWS, TorqueFit, is_torque_scale, range_of
from sysid_bench.types import Array

DOUBT: Final = "a doubt: "
"""Start of a reason that is a doubt."""

_AGREES: Final = 0.98
"""Correlation of distances above which a column is the derivative of another (`log_checks`)."""

_LAGS: Final = (1, 2, 5, 10, 20, 50, 100, 200)
_COMMON: Final = 1.2
"""Largest ratio of the rates of joints: drives estimate v with errors up to 18 %; torques have a
ratio of their own in each joint."""

_ENOUGH: Final = 0.6
"""Share of moving joints that have to agree: one encoder may be coarse, one gear may play."""

_ROWS: Final = 20_000
"""Rows that are compared."""

_SEEDS: Final = 30
"""Pairs of blocks from which a choice of disjoint ones starts."""

_UNIT_ERROR: Final = 0.05
"""Of the unit of time in rates: as for a declared rate (`log_checks`)."""

_STEADY: Final = 0.5
"""Spread of the steps of stamps over their median: clocks jitter, what warms up does more."""

_FRICTION: Final = 0.2
"""Share of friction over that of another block, below which a block was computed, not measured: the
torque that a controller computes from its model has none."""

_DRIFTS: Final = 0.02
"""Largest step over the range of a temperature, which no torque or rate of a motion has."""


@dataclass(frozen=True)
class Block:
    """Columns (from 0) of one role, a word of what is recorded, and how that is known."""

    columns: tuple[int, ...]
    role: str
    reason: str
    is_computed: bool = False  # torques of the joints that a controller computes

    @property
    def label(self) -> str:
        """First and last column from 1, or all where they do not stand side by side."""
        first, last = self.columns[0] + 1, self.columns[-1] + 1
        if last - first != len(self.columns) - 1:
            return ", ".join(str(column + 1) for column in self.columns)
        return f"{first}" if first == last else f"{first} to {last}"

    @property
    def text(self) -> str:
        """Sentence for a comment."""
        return f"{self.label}: {self.role}: {self.reason.removeprefix(DOUBT)}"


def explain_columns(values: Array, robot: RobotModel, joints: Sequence[str]) -> list[Block]:
    """Return the role of every column of values (N, c), in their order.

    `joints`: those of the robot that may be recorded, in the order of their columns.
    """
    empty = ~np.isfinite(values).any(axis=0)
    X = values[~check_finite(values[:, ~empty])][:_ROWS]
    empty |= len(X) < 2
    blocks = [Block((int(i),), "unexplained", "no numbers") for i in np.flatnonzero(empty)]
    rising = {} if len(X) < 2 else _rising(X, np.flatnonzero(~empty).tolist())
    free = [i for i in range(values.shape[1]) if not empty[i] and i not in rising]
    time = next((i for i, (_, is_counter) in rising.items() if not is_counter), None)
    t = X[:, time] if time is not None else np.arange(float(len(X)))
    motion = _Motion.of(X, free, t, len(joints))
    if time is None and motion is not None and motion.step is not None:
        step = motion.step
        motion = replace(motion, t=t * step)
        # A row number is a time where the rates count in its unit.
        units = [abs(step / unit - 1.0) < _UNIT_ERROR for unit in (1e-3, 1e-6, 1e-9)]
        time = next(iter(rising), None) if any(units) else None
    for i, (by, _) in rising.items():
        role = "time" if i == time else "counter"
        blocks.append(Block((i,), role, f"it rises in every row, by {by:.4g}"))
    found = motion.blocks(robot, joints) if motion is not None else []
    taken = {column for block in found for column in block.columns}
    left = [i for i in free if i not in taken]
    blocks += [*found, *_left_over(X, left, len(joints), bool(found))]
    return sorted(blocks, key=lambda block: block.columns)


def _rising(X: Array, columns: Sequence[int]) -> dict[int, tuple[float, bool]]:
    """Return the columns that rise, with their median step, and whether they count rows."""
    steps = np.diff(X, axis=0)
    rises = [i for i in columns if (steps[:, i] >= 0).mean() > 0.95 < 2 * (steps[:, i] > 0).mean()]
    middle = [np.quantile(steps[steps[:, i] > 0, i], (0.25, 0.5, 0.75)) for i in rises]
    found = [i for i, q in zip(rises, middle, strict=True) if q[2] - q[0] <= _STEADY * q[1]]
    # A counter steps by the same whole number; stamps in whole units differ now and then.
    counts = {i: bool(np.ptp(steps[:, i]) == 0 and steps[0, i] == 1) for i in found}
    return {i: (float(np.median(steps[:, i])), counts[i]) for i in found}


@dataclass(frozen=True, eq=False)
class _Motion:
    """Positions, rates and accelerations among the columns X (N, c): pairs of blocks of k columns,
    `stride` apart, of which one is the derivative of the other, by their first columns; `second`:
    it is the second derivative. Stamps t (N,); `step`: the unit of t in which the rates count."""

    X: Array
    t: Array
    free: frozenset[int]
    k: int
    stride: int
    pairs: tuple[tuple[int, int], ...]
    second: bool = False
    step: float | None = None

    @classmethod
    def of(cls, X: Array, free: Sequence[int], t: Array, joints: int) -> "_Motion | None":
        """Find the largest blocks that are derivatives; None where there is nothing to compare."""
        if len(X) < 5 * _LAGS[1] or not free or not joints:
            return None
        rises = np.diff(t) > 0
        rate = np.gradient(X, axis=0) / max(float(np.median(np.diff(t)[rises])), 1e-300)
        # Columns beyond the joints may be a gripper's; fewer are part of the robot.
        widths = [joints, *range(joints + 3, joints, -1), *range(joints - 1, (joints - 1) // 2, -1)]
        widths.sort(key=lambda k: (k < joints, -k))
        for second, source in ((False, X), (True, rate)):
            # Correlation (c, c) and ratio of the distances of columns X (N, c) and of the
            # integrals of Y over t, at the lag of the best agreement: 1 where Y is the derivative
            # of X
            integral = np.zeros_like(X)
            integral[1:] = np.cumsum(0.5 * (X[1:] + X[:-1]) * np.diff(t)[:, None], axis=0)
            best, ratio = np.zeros((source.shape[1],) * 2), np.full((source.shape[1],) * 2, np.nan)
            for lag in (lag for lag in _LAGS if lag <= len(source) // 5):
                moved, summed = source[lag:] - source[:-lag], integral[lag:] - integral[:-lag]
                moved, summed = moved - moved.mean(axis=0), summed - summed.mean(axis=0)
                sizes = np.linalg.norm(moved, axis=0), np.linalg.norm(summed, axis=0)
                product_of = np.maximum(np.outer(*sizes), 1e-300)
                correlation = moved.T @ summed / product_of
                better = correlation > best
                best[better] = correlation[better]
                with np.errstate(divide="ignore", invalid="ignore"):
                    ratio[better] = (sizes[0][:, None] / sizes[1][None])[better]
            table = best, ratio
            for k, stride in product(widths, range(1, 7)):
                pairs = tuple(_pairs(X, table, frozenset(free), k, stride, k == joints))
                if pairs:
                    span = stride * np.arange(k)
                    steps = table[1][pairs[0][0] + span, pairs[0][1] + span]
                    step = None if second else float(np.nanmedian(steps))
                    found = cls(X, t, frozenset(free), k, stride, pairs)
                    return replace(found, second=second, step=step)
        return cls(X, t, frozenset(free), joints, 1, ())

    def columns(self, first: int) -> tuple[int, ...]:
        """Columns of the block that begins with `first`."""
        return tuple(first + self.stride * j for j in range(self.k))

    def _label(self, first: int) -> str:
        return Block(self.columns(first), "", "").label

    def blocks(self, robot: RobotModel, joints: Sequence[str]) -> list[Block]:
        """Blocks of the motion, then those that follow the torque of the model along it."""
        sources = dict.fromkeys(a for a, _ in self.pairs)
        derived = dict.fromkeys(b for _, b in self.pairs)
        positions = self._measured([a for a in sources if a not in derived])
        found = []
        for n, q in enumerate(positions):
            v = [b for a, b in self.pairs if a == q]
            kind = "second derivative" if self.second else "derivative"
            reason = f"{', '.join(map(self._label, v))} is its {kind}"
            role = "position"
            if n:
                role = "command"
                reason = f"positions as {self._label(positions[0])}, with less noise; {reason}"
            elif len(positions) > 1:
                reason = f"{DOUBT}{reason}; noisier than {self._label(positions[1])}: measured"
            found.append(Block(self.columns(q), role, reason))
        rates = [b for b in derived if any(a in positions for a, c in self.pairs if c == b)]
        for n, rate in enumerate(self._measured(rates)):
            role = "acceleration" if self.second else "command" if n else "velocity"
            found.append(Block(self.columns(rate), role, "derivative of the positions"))
        for b in (b for b in derived if b not in rates):
            found.append(Block(self.columns(b), "acceleration", "derivative of the velocities"))
        if not positions:
            return self._by_model(robot, joints)
        _, torques = self._torques(robot, joints, found)
        if not torques and not self.second:
            doubt = f"{DOUBT}{found[0].reason}, or velocities and accelerations: no torque tells"
            found[0] = replace(found[0], reason=doubt)
        return [*found, *torques]

    def _measured(self, firsts: Sequence[int]) -> list[int]:
        """Blocks of one kind, the noisiest first: a command is smooth."""

        def noise(first: int) -> float:
            x = self.X[:, self.columns(first)]
            moving = np.ptp(x, axis=0) > 0
            return float(
                np.median(np.diff(x[:, moving], 3, axis=0).std(axis=0) / x[:, moving].std(0))
            )

        return sorted(firsts, key=noise, reverse=True)

    def _windows(self, taken: frozenset[int]) -> Iterator[int]:
        """First columns of blocks that are neither taken nor something else."""
        left = self.free - taken
        return (first for first in sorted(left) if left.issuperset(self.columns(first)))

    def _by_model(self, robot: RobotModel, joints: Sequence[str]) -> list[Block]:
        """Positions without any derivative: those along which the model explains another block."""
        best: tuple[float, list[Block]] = (0.0, [])
        for q in list(self._windows(frozenset()))[:: max(1, self.k)][:_SEEDS]:
            reason = "the model's torque along it follows another"
            block = Block(self.columns(q), "position", reason)
            score, torques = self._torques(robot, joints, [block])
            best = max(best, (score, [block, *torques]), key=lambda one: one[0])
        return best[1]

    def _torques(
        self, robot: RobotModel, joints: Sequence[str], motion: Sequence[Block]
    ) -> tuple[float, list[Block]]:
        """Score of the best of the blocks that follow the model's torque, and these blocks, the
        measured one first."""
        fit = TorqueFit.of(self.X[:, motion[0].columns], self.t, robot, joints)
        taken = frozenset(column for block in motion for column in block.columns)
        if fit is None:
            return 0.0, []
        scores = {a: fit.follows(self.X[:, self.columns(a)]) for a in self._windows(taken)}
        found: dict[int, tuple[float, Array, float]] = {}
        for a in sorted(scores, key=lambda a: -scores[a][0]):
            used = {column for b in found for column in self.columns(b)}
            if scores[a][0] > FOLLOWS and used.isdisjoint(self.columns(a)):
                found[a] = scores[a]
        most = max((f for *_, f in found.values()), default=0.0)
        rubbing = [a for a in found if found[a][2] > _FRICTION * most]
        # Where gravity does not show the scale, a gain has to be stated, if only as 1.
        is_torque = {a: len(x) > 0 and is_torque_scale(x) for a, (_, x, _) in found.items()}
        chosen = [a for a in rubbing if is_torque[a]] or rubbing
        ordered = self._measured(chosen) if len(chosen) > 1 else chosen
        blocks = []
        for a in (*ordered, *(a for a in found if a not in ordered)):
            score, slopes, _ = found[a]
            reason = (
                f"it follows the model's torque along the motion ({score:.0%} beyond friction), "
                f"{range_of(slopes)}"
            )
            role = "torque" if is_torque[a] else "current"
            if a not in rubbing:
                role, reason = "command", f"{reason}, without friction: computed, not measured"
            elif a != ordered[0]:
                reason = f"{reason}; not taken beside {self._label(ordered[0])}"
            elif len(ordered) > 1:
                reason = f"{DOUBT}{reason}, noisier than {self._label(ordered[1])}: measured"
            blocks.append(Block(self.columns(a), role, reason, role == "command" and is_torque[a]))
        return max((score for score, *_ in found.values()), default=0.0), blocks


def _pairs(
    X: Array, table: tuple[Array, Array], free: frozenset[int], k: int, stride: int, loose: bool
) -> list[tuple[int, int]]:
    """Return first columns of disjoint blocks (a, b) of which b is the derivative of a."""
    moving, (correlation, ratio) = np.ptp(X, axis=0) > 0, table
    span = stride * np.arange(k)
    starts = [i for i in sorted(free) if free.issuperset((i + span).tolist())]
    scored: list[tuple[float, int, int]] = []
    for a, b in product(starts, starts):
        at, to = a + span, b + span
        move = moving[at] & moving[to]
        if set(at) & set(to) or 2 * move.sum() < k:
            continue
        agree = correlation[at[move], to[move]]
        kept = agree > _AGREES
        rates = ratio[at[move], to[move]][kept]
        need = _ENOUGH if loose and k > 2 else 1.0
        if kept.mean() >= need and rates.max() <= _COMMON * rates.min():
            scored.append((float(kept.sum() + agree.mean()), a, b))
    scored.sort(reverse=True)
    # Of blocks side by side, q v a, pairs are also derivatives one column aside: the choice that
    # makes most pairs is the one of whole blocks.
    sets = [list(_disjoint([one, *scored], span)) for one in scored[:_SEEDS]]
    return max(sets, key=len, default=[])


def _disjoint(scored: Sequence[tuple[float, int, int]], span: Array) -> Iterator[tuple[int, int]]:
    """Yield pairs of blocks, the first ones first, of which no two overlap."""
    chosen: list[int] = []
    for _, a, b in dict.fromkeys(scored):
        used = [set(first + span) for first in chosen]
        if all(
            first in chosen or not any(set(first + span) & one for one in used) for first in (a, b)
        ):
            chosen += [first for first in (a, b) if first not in chosen]
            yield a, b


def _left_over(X: Array, left: Sequence[int], k: int, known: bool) -> Iterator[Block]:
    """Yield blocks of the columns that nothing explains: constant, a temperature, or neither."""

    def kind(i: int) -> tuple[str, str]:
        x = X[:, i]
        if np.ptp(x) == 0:
            return "constant", f"{x[0]:.4g} in every row"
        if np.abs(np.diff(x)).max() < _DRIFTS * np.ptp(x) and x.min() > 0 and np.ptp(x) < x.min():
            return "temperature", f"a slow drift from {x[0]:.4g} to {x[-1]:.4g}"
        return "unexplained", "neither a derivative of others nor a torque of the model"

    if not known and len(left) == k and any(kind(i)[0] == "unexplained" for i in left):
        yield Block(tuple(left), "position", f"{DOUBT}the only columns, one for each joint")
        return
    for (role, reason), group in groupby(left, key=kind):
        yield Block(tuple(group), role, reason)
