"""Verb `transfer`: what comparisons of methods on simulated replays predict of recorded robots."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import click

from sysid_bench.apps.twins.commands.twin import TRUTHS, figure_option, jobs_option
from sysid_bench.commands.request import OK, Request, argument, option
from sysid_bench.commands.result import Result
from sysid_bench.commands.values import parse_names
from sysid_bench.errors import unknown_name

if TYPE_CHECKING:
    from sysid_bench.apps.twins.agreement import Errors, VerdictCounts
    from sysid_bench.apps.twins.commands.transfer_sources import Sources, TransferSource

METHODS: Final = (
    *("ols", "wls", "irls", "huber", "tukey", "ridge"),
    *("lmi", "entropic", "a-priori", "file-friction"),
)
"""Methods that are compared where none are named."""

MOST_FALSE, LEAST_FOUND = 0.2, 0.5
"""Aims of a simulation: shares of its claims that are false, and of real differences found."""

UNDECIDED: Final = "not decided"
SINGLE: Final = "not decided, single type"

OTHER, ALL = "another motion or day", "all sets"
"""Groups of sets: those whose test is another motion or another day, and all."""

_APART: Final = ("another motion", "another day")

LEVELS: Final = ("L0", "L1", "L2", "L3", "L4")
"""Plants by level, whose robot is the identified model."""

TWIN, NULL, CEILING = "twin", "null twin", "recorded"
"""Sources besides the levels; the last one is one part of the recorded tests against the other."""


def source_label(source: str, truth: str) -> str:
    """Return a source with the identified model that moves in it: "L1, wls"."""
    return f"{source}, {truth}"


class TransferRequest(Request["TransferResult"]):
    """Compare methods on recorded robots and on replays: what does simulation predict?"""

    sets: Sequence[str] = argument("SET...", several=True, complete="datasets folders")
    truth: Sequence[str] = option(
        "Identified models that move; default: both.",
        default=TRUTHS, metavar="wls,lmi", parse=lambda text: parse_names(text) or TRUTHS,
        complete="truths", separated=True,
    )  # fmt: skip
    methods: Sequence[str] = METHODS
    levels: Sequence[str] = LEVELS
    draws: int = option("Draws of the noise.", default=3, least=1, shown=True)
    seed: int = option("Seed of the noise.", default=0, least=0, shown=True)
    figure: str | Path | None = figure_option()
    jobs: int = jobs_option()

    def run(self) -> "TransferResult":
        """Compare the methods; no set is announced as it is done."""
        return self.compare(None)

    def shell(self, as_json: bool) -> int:
        from sysid_bench.commands.terminal import print_result

        print_result(self.compare(partial(click.echo, err=True)), as_json)
        return OK

    def compare(self, progress: Callable[[str], None] | None) -> "TransferResult":
        """Compare the methods; `progress` is called with each set that is done."""
        from sysid_bench.apps.twins.commands.transfer_sources import Sources
        from sysid_bench.apps.twins.recorded_robot import METHOD, of_data_set
        from sysid_bench.reporting.error_figures import transfer_figure

        _check_names(self.truth, self.methods, self.levels)
        sets, truths = self.sets, tuple(self.truth)
        methods = tuple(dict.fromkeys((METHOD, *self.methods)))
        tried = {
            name: Sources(of_data_set(name), methods, truths, self.draws, self.seed)
            for name in sets
        }
        found = self._errors_by_set(tried, progress)
        counts = _counts({name: found[name].errors for name in sets})
        figures = _figures(counts)
        if self.figure is not None:
            transfer_figure.write(Path(self.figure), next(iter(figures.values())))
        return TransferResult(
            sets=list(sets),
            methods=list(methods),
            truths=list(truths),
            draws=self.draws,
            errors={name: dict(found[name].errors) for name in sets},
            counts={
                source: {name: asdict(one) for name, one in by_set.items()}
                for source, by_set in counts.items()
            },
            figures=figures,
            reasons={name: found[name].reasons for name in sets if found[name].reasons},
            seconds=sum(one.seconds for one in found.values()),
        )

    def _errors_by_set(
        self, sources: "Mapping[str, Sources]", progress: Callable[[str], None] | None
    ) -> "dict[str, TransferSource]":
        from sysid_bench.apps.twins.recorded_robot import run_work

        work = {name: partial(one.errors, self.levels) for name, one in sources.items()}
        found: dict[str, TransferSource] = {}
        for name, source in run_work(work, self.jobs):
            found[name] = source
            if progress is not None:
                progress(f"{name}: {source.seconds:.0f} s")
        return found


def transfer(
    sets: Sequence[str],
    *,
    truth: Sequence[str] = TRUTHS,
    methods: Sequence[str] = METHODS,
    levels: Sequence[str] = LEVELS,
    draws: int = 3,
    seed: int = 0,
    figure: str | Path | None = None,
    jobs: int = 1,
    progress: Callable[[str], None] | None = None,
) -> "TransferResult":
    """Compare methods on recorded test motions and on replays of plants by level and of twins.

    The robot of all replays is the identified model (`truth`: "wls", "lmi" or both). Errors refer
    to the measured torque, noisy in simulation, of `draws` draws. `jobs` processes share the sets;
    `progress` is called with each that is done. `figure`: a picture of the shares. Raises
    UsageError for unknown sets, methods, levels and models; a source that fails has a reason.
    `wls`, to which all methods are compared, is always among them.
    """
    return TransferRequest(
        sets=sets,
        truth=truth,
        methods=methods,
        levels=levels,
        draws=draws,
        seed=seed,
        figure=figure,
        jobs=jobs,
    ).compare(progress)


@dataclass(frozen=True, eq=False, repr=False)
class TransferResult(Result):
    """Transfer from simulated sources to recorded robots.

    `errors`: torque error by set, source, draw, test and method. `counts`: by source and set, all
    draws together, see VerdictCounts. `figures`: by group of sets and source, `false` claims, real
    differences `found`, and the medians `level`, `misfit` and `tau`, each with its interval over
    robots, of which those of one type are drawn together; `without_one`: smallest and largest of
    both shares with one type left out, and whether the aims are reached in each. `reasons`: sources
    that failed, by set. `seconds`: CPU time.
    """

    sets: list[str]
    methods: list[str]
    truths: list[str]
    draws: int
    errors: dict[str, dict[str, Any]]
    counts: dict[str, dict[str, dict[str, float]]]
    figures: dict[str, dict[str, dict[str, Any]]]
    reasons: dict[str, dict[str, str]]
    seconds: float

    def __post_init__(self) -> None:
        self._make_plain()

    def summary(self) -> str:
        """Markdown tables: transfer by source for each group of sets, and the counts by set."""
        lines = []
        for group, figures in self.figures.items():
            lines += [f"{group}:", "", *_HEAD, *(_line(s, figures[s]) for s in figures), ""]
            lines += [f"Aim: {', '.join(self._verdicts(figures))}.", ""]
        lines += [*_SET_HEAD, *self._set_lines()]
        failed = [
            f"- {name}, {source}: {reason}"
            for name, reasons in self.reasons.items()
            for source, reason in reasons.items()
        ]
        return "\n".join([*lines, *(["", "Failed:", "", *failed] if failed else [])])

    def _set_lines(self) -> Iterator[str]:
        """Counts of pairs of methods by source and set, means of the draws."""
        for source, by_set in self.counts.items():
            n = 1 if source == CEILING else self.draws
            for name, one in by_set.items():
                pairs = [f"{one[x] / n:.3g}" for x in ("claimed", "false", "real", "found")]
                values = [one[x] for x in ("level", "misfit", "tau")]
                cells = [*pairs, *("-" if x is None else f"{x:.2f}" for x in values)]
                yield f"| {name} | {source} | {' | '.join(cells)} |"

    def _verdicts(self, figures: Mapping[str, Mapping[str, Any]]) -> Iterator[str]:
        """Verdicts of the sources on the aims; open where they depend on the identified model."""
        words = {
            True: "reached", False: "missed", None: "not testable (no real differences)",
            UNDECIDED: "not decided (one type of robot more or less changes it)",
            SINGLE: "not decided (one type of robot alone, and none to confirm it)",
        }  # fmt: skip
        bases = dict.fromkeys(label.rpartition(", ")[0] for label in figures if label != CEILING)
        for base in bases:
            labels = [source_label(base, truth) for truth in self.truths]
            # Where the identified models disagree, the verdict is one on the model, not on the
            # source.
            reached = {_decided(figures[label]) for label in labels if label in figures}
            yield f"{base} {words[reached.pop()] if len(reached) == 1 else 'open'}"


_HEAD: Final = (
    "| source | robots | level | misfit | tau | false claims | real differences found "
    "| without one type: false, found |",
    "| --- | ---: | --- | --- | --- | --- | --- | --- |",
)
_SET_HEAD: Final = (
    "Pairs of methods by set, means of the draws:",
    "",
    "| set | source | claimed | false | real | found | level | misfit | tau |",
    "| --- | --- | ---: | ---: | ---: | ---: | ---: | ---: | ---: |",
)


def _reaches(figures: Mapping[str, Any]) -> bool | None:
    """True for a source that reaches the aims; None where no methods differ in reality."""
    false, found = figures["false"]["value"], figures["found"]["value"]
    if found is None:
        return None
    return false is not None and false <= MOST_FALSE and found >= LEAST_FOUND


def _decided(figures: Mapping[str, Any]) -> bool | str | None:
    """Verdict on the aims: reached or missed, UNDECIDED where it changes without one type of
    robot, SINGLE where there is one type only."""
    reached = _reaches(figures)
    without = figures["without_one"]["reached"]
    if reached is not None and len(without) < 2:
        return SINGLE
    changes = any(one != reached for one in without)
    return UNDECIDED if reached is not None and changes else reached


def _line(source: str, figures: Mapping[str, Any]) -> str:
    cells = [_text(figures[word], 1, ".2f") for word in ("level", "misfit", "tau")]
    cells += [_text(figures[word], 100, ".0f") for word in ("false", "found")]
    ranges = [figures["without_one"][word] for word in ("false", "found")]
    cells.append(", ".join("-" if r is None else f"{r[0]:.0%} to {r[1]:.0%}" for r in ranges))
    return f"| {source} | {figures['robots']} | {' | '.join(cells)} |"


def _text(figure: Mapping[str, Any], scale: int, form: str) -> str:
    """Value and interval: of a median, or of a share of pairs in per cent."""
    if figure["value"] is None:
        return "-"
    of = "" if scale == 1 else f" % of {figure['count']}"
    value = f"{scale * figure['value']:{form}}{of}"
    if figure["low"] is None:
        return value
    return f"{value} [{scale * figure['low']:{form}}, {scale * figure['high']:{form}}]"


def _check_names(truths: Sequence[str], methods: Sequence[str], levels: Sequence[str]) -> None:
    """Raise UsageError for names that do not exist."""
    from sysid_bench.harness.suite.plugin_entries import with_plant_file
    from sysid_bench.plugin_names import build

    for truth in truths:
        if truth not in TRUTHS:
            raise unknown_name("truth of a twin", truth, TRUTHS)
    for level in levels:
        with_plant_file({"use": level}, None)
    for method in methods:
        build("estimator", method)


def _counts(
    errors: "Mapping[str, Mapping[str, list[list[Errors]]]]",
) -> "dict[str, dict[str, VerdictCounts]]":
    """Counts by source and set, those of CEILING first."""
    from sysid_bench.apps.twins.agreement import mean_counts, verdict_counts
    from sysid_bench.apps.twins.recorded_robot import METHOD

    counts: dict[str, dict[str, VerdictCounts]] = {CEILING: {}}
    for name, sources in errors.items():
        (real,) = sources[CEILING]
        for source, draws in sources.items():
            # Of CEILING the first recorded test is taken for simulated.
            pairs = [(real[:1], real[1:])] if source == CEILING else [(one, real) for one in draws]
            # All verdicts refer to the reference: a draw in which it failed has none.
            usable = [pair for pair in pairs if _have_errors(pair, METHOD)]
            if usable:
                of_draws = [verdict_counts(*pair, METHOD) for pair in usable]
                counts.setdefault(source, {})[name] = mean_counts(of_draws)
    return {source: by_set for source, by_set in counts.items() if by_set}


def _have_errors(pair: "Iterable[Sequence[Errors]]", method: str) -> bool:
    """True where the method has errors on each test of a simulated and a real motion."""
    return all(tests and all(method in one for one in tests) for tests in pair)


def _figures(
    counts: "Mapping[str, Mapping[str, VerdictCounts]]",
) -> dict[str, dict[str, dict[str, Any]]]:
    """Figures by group of sets and source."""
    from sysid_bench.models.data_sets import find_dataset

    sets = dict.fromkeys(chain.from_iterable(counts.values()))
    described = {name: find_dataset(name).described for name in sets}
    apart = [name for name, one in described.items() if one.split in _APART]
    types = {name: one.robot_type or name for name, one in described.items()}
    groups = {OTHER: apart} if apart == list(described) else {OTHER: apart, ALL: list(described)}
    return {
        group: {
            source: _of_robots({name: by_set[name] for name in names if name in by_set}, types)
            for source, by_set in counts.items()
        }
        for group, names in groups.items()
        if names
    }


def _of_robots(by_set: "Mapping[str, VerdictCounts]", types: Mapping[str, str]) -> dict[str, Any]:
    from sysid_bench.apps.twins.agreement import robot_median, robot_share

    counts, clusters = list(by_set.values()), [types[name] for name in by_set]

    def shares(left_out: str | None) -> dict[str, Any]:
        kept = [k for k, one in enumerate(clusters) if one != left_out]
        some, of = [counts[k] for k in kept], [clusters[k] for k in kept]
        return {
            "false": asdict(robot_share(some, lambda one: (one.false, one.claimed), of)),
            "found": asdict(robot_share(some, lambda one: (one.found, one.real), of)),
        }

    every = [shares(one) for one in dict.fromkeys(clusters)]
    without: dict[str, Any] = {"reached": [_reaches(one) for one in every]}
    for word in ("false", "found"):
        known = [one[word]["value"] for one in every if one[word]["value"] is not None]
        without[word] = [min(known), max(known)] if known else None
    medians = {
        word: asdict(robot_median([getattr(one, word) for one in counts], clusters))
        for word in ("level", "misfit", "tau")
    }
    return {"robots": len(counts), **shares(None), "without_one": without, **medians}
