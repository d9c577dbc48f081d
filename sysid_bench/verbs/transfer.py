"""Transfer: what comparisons of methods on simulated replays predict of recorded robots."""

import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from sysid_bench.errors import EstimationError, SysidBenchError
from sysid_bench.harness.suite.plant_file import with_plant_file
from sysid_bench.models.robot import RobotModel
from sysid_bench.naming import build
from sysid_bench.twins.recorded_robot import METHOD, Posed, RecordedRobot, residuals
from sysid_bench.twins.replay import Replayed, replay_rate
from sysid_bench.twins.residual_figures import Residual, torque_errors
from sysid_bench.twins.transfer_figures import (
    Errors,
    PairCounts,
    pair_counts,
    share_over_robots,
)
from sysid_bench.verbs.recorded_set import RecordedChoice, recorded_set
from sysid_bench.verbs.result import Result
from sysid_bench.verbs.twin import identified_robot

METHODS: Final = (
    *("ols", "wls", "irls", "huber", "tukey", "ridge"),
    *("lmi", "entropic", "a-priori"),
)
"""Methods that are compared where none are named."""

LEVELS: Final = ("L0", "L1", "L2", "L3", "L4")
"""Plants by level, whose robot is the identified model."""

TWIN, NULL, CEILING = "twin", "null twin", "recorded"
"""Sources besides the levels; the last one is one part of the recorded tests against the other."""


@dataclass(frozen=True, eq=False, repr=False)
class TransferResult(Result):
    """Transfer from simulated sources to recorded robots.

    `errors`: torque error by set, source, test and method. `counts`: by source and set, see
    PairCounts. `shares`: by source, `false` claims and real differences `found`, with intervals
    over robots, and the medians `level` and `misfit`. `reasons`: sources that failed, by set.
    """

    sets: list[str]
    methods: list[str]
    truth: str
    errors: dict[str, dict[str, list[dict[str, float]]]]
    counts: dict[str, dict[str, dict[str, float]]]
    shares: dict[str, dict[str, Any]]
    reasons: dict[str, dict[str, str]]

    def __post_init__(self) -> None:
        self._make_plain()

    def summary(self) -> str:
        """Markdown tables: transfer by source, and the errors of each set."""
        lines = [
            "| source | robots | level | misfit | false claims | real differences found |",
            "| --- | ---: | ---: | ---: | --- | --- |",
            *(_share_line(source, self.shares[source]) for source in self.shares),
        ]
        for name in self.sets:
            lines += ["", f"{name}: torque error", "", *self._error_lines(name)]
        failed = [
            f"{name}, {source}: {reason}"
            for name, reasons in self.reasons.items()
            for source, reason in reasons.items()
        ]
        return "\n".join([*lines, *(["", *failed] if failed else [])])

    def _error_lines(self, name: str) -> list[str]:
        found = self.errors[name]
        columns = [(s, k) for s, tests in found.items() for k in range(len(tests))]
        heads = [f"{s} {k + 1}" if len(found[s]) > 1 else s for s, k in columns]
        lines = [
            f"| method | {' | '.join(heads)} |",
            f"| --- |{' ---: |' * len(heads)}",
        ]
        for method in self.methods:
            cells = [found[source][k].get(method) for source, k in columns]
            words = ["-" if error is None else f"{error:.3g}" for error in cells]
            lines.append(f"| {method} | {' | '.join(words)} |")
        return lines


def _share_line(source: str, shares: Mapping[str, Any]) -> str:
    return (
        f"| {source} | {shares['robots']} | {shares['level']:.2f} | {shares['misfit']:.2f} | "
        f"{_share_text(shares['false'])} | {_share_text(shares['found'])} |"
    )


def _share_text(share: Mapping[str, Any]) -> str:
    if share["value"] is None:
        return "-"
    text = f"{100 * share['value']:.0f} % of {share['pairs']}"
    if share["low"] is None:
        return text
    return f"{text} [{100 * share['low']:.0f}, {100 * share['high']:.0f}]"


def transfer(
    sets: Sequence[str],
    *,
    truth: str = "wls",
    methods: Sequence[str] = METHODS,
    levels: Sequence[str] = LEVELS,
    seed: int = 0,
    progress: Callable[[str], None] | None = None,
) -> TransferResult:
    """Compare methods on recorded test motions and on replays of plants by level and of twins.

    The robot of all replays is the identified model (`truth`: "wls" or "lmi"). Errors refer to the
    measured torque, noisy in simulation. `progress` is called with each set and source. Raises
    UsageError for unknown sets, methods and levels; a source that fails has a reason. `wls`, to
    which all methods are compared, is always among them.
    """
    for level in levels:
        with_plant_file({"use": level}, None)
    for method in methods:
        build("estimator", method)
    methods = tuple(dict.fromkeys((METHOD, *methods)))
    robots = {name: recorded_set(RecordedChoice(name)) for name in sets}
    errors: dict[str, dict[str, list[Errors]]] = {}
    reasons: dict[str, dict[str, str]] = {}
    for name, recorded in robots.items():
        tried = _Sources(recorded, tuple(methods), truth, seed, progress or (lambda text: None))
        errors[name], reasons[name] = tried.errors(name, levels)
    counts = _counts(errors)
    return TransferResult(
        sets=list(sets),
        methods=list(methods),
        truth=truth,
        errors={name: _plain_errors(found) for name, found in errors.items()},
        counts={source: _plain_counts(found) for source, found in counts.items()},
        shares={source: _shares(list(by_set.values())) for source, by_set in counts.items()},
        reasons={name: found for name, found in reasons.items() if found},
    )


def _plain_errors(sources: Mapping[str, list[Errors]]) -> dict[str, list[dict[str, float]]]:
    return {source: [dict(one) for one in tests] for source, tests in sources.items()}


def _plain_counts(by_set: Mapping[str, PairCounts]) -> dict[str, dict[str, float]]:
    return {name: asdict(one) for name, one in by_set.items()}


@dataclass(frozen=True, eq=False)
class _Sources:
    """Sources of data of one robot, on which the same methods are compared."""

    recorded: RecordedRobot
    methods: tuple[str, ...]
    truth: str
    seed: int
    progress: Callable[[str], None]

    def errors(
        self, name: str, levels: Sequence[str]
    ) -> tuple[dict[str, list[Errors]], dict[str, str]]:
        """Errors of each source by test, and why sources failed."""
        found, reasons = {CEILING: self._of(self.recorded.posed)}, dict[str, str]()
        with tempfile.TemporaryDirectory() as folder:
            try:
                robot = identified_robot(self.recorded, self.truth, Path(folder) / "twin.toml")
            except SysidBenchError as error:
                return found, {f"truth {self.truth}": str(error).partition(". ")[0]}
            for source in (*levels, NULL, TWIN):
                self.progress(f"{name}, {source}")
                try:
                    found[source] = self._of(self._replay(source, robot))
                except SysidBenchError as error:
                    reasons[source] = str(error).partition(". ")[0]
        return found, reasons

    def _replay(self, source: str, robot: RobotModel) -> Posed:
        if source in (TWIN, NULL):
            twin = fitted(self.recorded, robot, null=source == NULL)
            return self.recorded.replay(twin.replayed, twin.rate, self.seed)
        plant = Replayed(robot, with_plant_file({"use": source}, None))
        rate = self.recorded.posed.source.training[0].recording.rate
        return self.recorded.replay(plant, replay_rate(rate), self.seed)

    def _of(self, posed: Posed) -> list[Errors]:
        """Errors of each method by test; of the only test, by its halves."""
        by_method: dict[str, list[float]] = {}
        for method in self.methods:
            try:
                tests = residuals(posed, method)
            except EstimationError:
                continue
            parts = tests if len(tests) > 1 else _halves(tests[0])
            by_method[method] = [torque_errors([part]) for part in parts]
        count = min(map(len, by_method.values()), default=0)
        return [{m: tests[k] for m, tests in by_method.items()} for k in range(count)]


def _halves(residual: Residual) -> list[Residual]:
    middle = len(residual.e) // 2
    return [
        replace(residual, e=residual.e[part], torque=residual.torque[part])
        for part in (slice(None, middle), slice(middle, None))
    ]


def _counts(
    errors: Mapping[str, Mapping[str, list[Errors]]],
) -> dict[str, dict[str, PairCounts]]:
    """Counts by source and set; those of CEILING take the first recorded test for simulated."""
    counts: dict[str, dict[str, PairCounts]] = {}
    for name, sources in errors.items():
        real = sources[CEILING]
        for source, tests in sources.items():
            pair = (tests[:1], real[1:]) if source == CEILING else (tests, real)
            if all(pair) and all(METHOD in one for one in (*pair[0], *pair[1])):
                counts.setdefault(source, {})[name] = pair_counts(*pair, METHOD)
    return counts


def _shares(counts: Sequence[PairCounts]) -> dict[str, Any]:
    false = share_over_robots(counts, lambda one: (one.false, one.claimed))
    found = share_over_robots(counts, lambda one: (one.found, one.real))
    return {
        "robots": len(counts),
        "level": float(np.median([one.level for one in counts])),
        "misfit": float(np.median([one.misfit for one in counts])),
        "false": asdict(false),
        "found": asdict(found),
    }
