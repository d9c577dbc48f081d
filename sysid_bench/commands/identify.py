"""Verb `identify`: one robot, from its own simulation or from recordings of the real one."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import KW_ONLY, field, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, cast

import click

from sysid_bench.commands.request import (
    BAD_ANSWER,
    OK,
    Request,
    free_base_option,
    logs_option,
    option,
    python_function,
    robots_option,
    sensor_option,
    spec_of,
    task_option,
    terms_option,
)
from sysid_bench.commands.request import model as model_argument
from sysid_bench.commands.result import Result
from sysid_bench.commands.values import (
    parse_contact,
    parse_names,
    parse_noise,
    parse_payload,
    parse_pipeline,
    parse_prior,
)
from sysid_bench.errors import UsageError, WriteError

if TYPE_CHECKING:
    from sysid_bench.commands.identify_result import IdentifyResult
    from sysid_bench.experiments.spec import ExperimentSpec
    from sysid_bench.signals.log_description import LogDescription

PathLike = str | Path
LogLike = Any
"""Path of a description of a recording, its description, a data frame or a mapping of arrays."""

WORSE: Final = "worse"
"""Word of --accept for an answer that a baseline beats."""
SIMULATION: Final = ("--simulate",)
LOGS: Final = ("--log",)
DRIVES: Final = ("--task actuators",)
OF_LOGS: Final = {"when": LOGS}
"""Metadata of a field of Python alone that has a use with recordings alone."""


class Identify(Request["IdentifyResult"]):
    """Identify one robot: excite and simulate it, or read recordings; estimate; export.

    Exit code 3 where the answer errs more on its test than the model file with fitted friction, the
    mean torque or zero torque; it is written all the same.
    """

    model: PathLike = model_argument("MODEL")
    task: str = task_option()
    payload: str | Mapping[str, Any] = option(
        "Load mounted at the tool: a name, or a table '{ mass = 1.2, com = [0, 0, 0.05], "
        'inertia = "sphere 0.05 m" }\'.',
        default="none", shown=True, parse=parse_payload, complete="payloads", when=SIMULATION,
    )  # fmt: skip
    terms: Sequence[str] | None = terms_option()
    estimator: str | None = option(
        "Method. Default: ols; wls-guarded with logs; wls for wrench; min-norm for terminal.",
        default=None, metavar="NAME", complete="estimators",
    )  # fmt: skip
    noise: Mapping[str, Any] | None = option(
        "Sensor noise; default: none.",
        default=None, metavar="tau=0.5 %,q=1e-4 rad", parse=parse_noise, when=SIMULATION,
    )  # fmt: skip
    _: KW_ONLY
    log: LogLike | Sequence[LogLike] = logs_option(
        "log", "Data from a recording; several are used together."
    )
    test: LogLike | Sequence[LogLike] = logs_option("test", "Recording to judge on.", when=LOGS)
    simulate: bool | None = option("Data from the robot's own simulation.", default=None)
    model_out: PathLike | None = option(
        "The model file again, with identified values.",
        default=None, path="new", complete="files",
    )  # fmt: skip
    json_out: PathLike | None = option(
        "The result as a file.", default=None, path="new", complete="files"
    )
    robots_dir: Path | None = robots_option()
    seed: int = option("Seed of motion and noise.", default=0, shown=True, least=0, when=SIMULATION)
    sensor: str | None = sensor_option()
    free_base: bool | None = free_base_option()
    contacts: Sequence[str] | str | None = option(
        "Samples left out: detected behind a sensor, or in these periods.",
        default=None, metavar="detect|'10 s to 25 s'", parse=parse_contact, when=SIMULATION,
    )  # fmt: skip
    complete: str | None = option(
        "Whole, feasible bodies nearest to the prior in this distance.",
        default=None, choices=("entropic", "euclidean", "pullback"),
    )  # fmt: skip
    filter: str | None = option(
        "Logs: 'butter 4 10 Hz', ...; of tests, and of the pipeline plain.",
        default=None, metavar="TEXT", complete="filters", when=LOGS,
    )  # fmt: skip
    derivatives: str | None = field(default=None, metadata=OF_LOGS)
    moving: float = field(default=0.0, metadata=OF_LOGS)
    choose: Sequence[str] = option(
        "Logs: joint terms and features (play, playq, tanh, poly), also of motors "
        "(motor.play, motor.coulomb), that cross-validation in the training data may add.",
        default=(), metavar="play,offset,motor.play,...", parse=parse_names, complete="terms",
        separated=True, when=LOGS,
    )  # fmt: skip
    position_given: bool = option(
        "Logs, task payload: only its mass is unknown, centre of mass as the log states.",
        default=False, when=LOGS,
    )  # fmt: skip
    accept: Sequence[str] = option(
        "Contradictions in logs that may pass; worse: an answer worse than the model file.",
        default=(), metavar="rate,units,worse", parse=parse_names, complete="findings",
        separated=True, when=LOGS,
    )  # fmt: skip
    figure: PathLike | None = option(
        "Logs: measured and predicted torque and their difference, joint by joint.",
        default=None, metavar="FILE.pdf|svg", path="new", complete="files", when=LOGS,
    )  # fmt: skip
    pipeline: str | Mapping[str, Any] | None = option(
        "Signals and rows of the fit: plain, raw, parallel, or a table "
        '\'{ use = "parallel", cutoff = "6 Hz" }\'. Default: parallel; plain with --filter and '
        "where positions are exact.",
        default=None, metavar="NAME", parse=parse_pipeline, complete="pipelines",
    )  # fmt: skip
    prior: str | Mapping[str, Any] | None = option(
        "Logs: the model file's inertias where they are plausible (default), none, or "
        'their spreads, \'{ mass = "10 %", com = "20 mm" }\'.',
        default=None, metavar="model|none|TABLE", parse=parse_prior, complete="priors", when=LOGS,
    )  # fmt: skip
    feasible: str | None = option(
        "Logs, feasible fits: friction and rotor inertia are not negative either (terms, "
        "the default), or only the bodies are constrained.",
        default=None, choices=("terms", "bodies"), when=LOGS,
    )  # fmt: skip
    share: Sequence[str] = option(
        "Logs, task actuators: joints whose names hold the same word, or match the same "
        "pattern ('*_knee'), have equal armature and friction.",
        default=(), metavar="hip,knee,...", parse=parse_names, when=DRIVES,
    )  # fmt: skip
    also: Sequence[str] = option(
        "Logs, task actuators: further unknowns. Torque over that of the stated gains, "
        "position less that of the encoder, friction over the torque of the links; limits of the "
        "servo (torque, speed, dead band), each kept where it helps on data it was not chosen by.",
        default=(), metavar="gain,bias,load,limits", parse=parse_names, when=DRIVES,
    )  # fmt: skip

    def run(self) -> "IdentifyResult":
        """Identify a robot: from the recordings `log`, judged on `test`, or from its own
        simulation.

        `model`: a robot's name, a URDF or an MJCF file. A recording is the path of its description,
        or numbers in memory: see `sysid_bench.log_of`. None as `terms`: those of the task;
        `payload` (a name or a table) and `noise` ({"q": "1e-4 rad", "tau": "0.5 %"}) as in a suite;
        `free_base` overrides the robot's manifest. Of logs: `derivatives`, the signal that rates
        and accelerations come from ("from q", "from v"), and `moving`, the rate (rad/s, m/s) below
        which samples of a joint are left out. `json_out`: file of the result. Raises UsageError for
        unknown names or contradictory data, ModelError for a model that cannot be used or values
        that must not be written, EstimationError where the method fails.
        """
        asked, json_out = self._checked(), self.files[1]
        try:
            result = asked._answer()
        except WriteError as error:  # a model that is refused does not lose the result
            if json_out is not None and isinstance(error.result, Result):
                error.result.write_json(json_out)
            raise
        if json_out is not None:
            result.write_json(json_out)
        return result

    def _checked(self) -> "Identify":
        """The request with its recordings found; raise UsageError for options of another source of
        data."""
        from sysid_bench.commands.task_terms import check_term_names
        from sysid_bench.signals.log_data import log_list

        logs, tests = log_list(self.log, "log"), log_list(self.test, "test")
        if (self.simulate is False and not logs) or (self.simulate and logs):
            raise UsageError(
                "Where do the data come from? Give --log LOG.toml for a recording, or --simulate "
                "for the robot's simulation."
            )
        check_term_names(self.terms, features=True)
        asked = replace(self, model=str(self.model), log=logs, test=tests)
        if logs:
            reason = "for simulated data only (--simulate). A log states its payload itself."
            asked._refuse(reason, SIMULATION)
        else:
            asked._refuse("for recordings only (--log).", LOGS, DRIVES)
        return asked

    def _refuse(self, reason: str, *conditions: Sequence[str]) -> None:
        """Raise UsageError for given options that have a use under these conditions alone."""
        given = []
        for entry in fields(self):
            spec, value = spec_of(entry), getattr(self, entry.name)
            when = entry.metadata.get("when") if spec is None else spec.when
            # A seed does no harm where nothing is drawn.
            if when in conditions and entry.name != "seed" and value and value != entry.default:
                given.append(f"--{entry.name.replace('_', '-')}")
        if given:
            raise UsageError(f"{', '.join(given)}: {reason}")

    def _answer(self) -> "IdentifyResult":
        """Run one cell of the simulated or recorded robot, or what the task has in its place."""
        from sysid_bench.commands.task_terms import verb_of_task
        from sysid_bench.experiments.tasks.task import find_task
        from sysid_bench.models.sources import with_settings

        if not self.log:
            # Loading what simulates takes as long as a recording of 10 s takes to be identified.
            from sysid_bench.commands.identify_simulated import identify_simulated

            return identify_simulated(self)
        task = find_task(self.task)
        if self.sensor and not task.measures_sensor_only:
            raise UsageError(
                "--sensor: of a recording, for the task 'wrench' only: other tasks use joint "
                "torques."
            )
        asked = replace(self, model=with_settings(str(self.model), {"free_base": self.free_base}))
        if own := verb_of_task(task, "identify"):
            return cast("IdentifyResult", own(asked))
        self._refuse("for the task 'actuators' only.", DRIVES)
        from sysid_bench.commands.identify_recorded import identify_recorded

        return identify_recorded(asked)

    def recordings(self) -> "tuple[list[LogDescription], dict[str, LogDescription]]":
        """The training recordings, and the tests by the stem of their file; where two stems are the
        same by their whole path, with a number where two paths are: motions of one data set."""
        from sysid_bench.signals.log_description import find_description

        tests = [find_description(log) for log in self.test]
        stems = [test.source.stem for test in tests]
        labels = [
            stem if stems.count(stem) == 1 else str(test.source)
            for stem, test in zip(stems, tests, strict=True)
        ]
        labels = [
            label if labels.count(label) == 1 else f"{label} {k}"
            for k, label in enumerate(labels, start=1)
        ]
        return [find_description(log) for log in self.log], dict(zip(labels, tests, strict=True))

    def specification(self, **data: Any) -> "ExperimentSpec":
        """The experiment of this request; `data`: fields of its source."""
        from sysid_bench.experiments.spec import ExperimentSpec, normal_noise, normal_payload

        return ExperimentSpec(
            seed=self.seed,
            robot=str(self.model),
            payload=normal_payload(self.payload),
            task=self.task,
            terms=None if self.terms is None else tuple(self.terms),
            noise=normal_noise(self.noise or {}),
            repeat=0,
            sensor=self.sensor,
            free_base=self.free_base,
            **data,
        )

    @property
    def findings(self) -> tuple[str, ...]:
        """Contradictions in logs that are accepted."""
        return tuple(name for name in self.accept if name != WORSE)

    @property
    def files(self) -> tuple[Path | None, Path | None, Path | None]:
        """Files to be written: model, JSON, figure."""
        names = (self.model_out, self.json_out, self.figure)
        model_out, json_out, figure = (None if one is None else Path(one) for one in names)
        return model_out, json_out, figure

    def pipeline_with_default(self, default: dict[str, Any] | None) -> dict[str, Any] | None:
        """The pipeline as an experiment names it; the default one where none is given."""
        from sysid_bench.signals.pipeline_choice import pipeline_spec

        if self.pipeline is None:
            return default
        written = self.pipeline
        return pipeline_spec({"use": written} if isinstance(written, str) else written)

    def plugins(self) -> Iterator[tuple[str, str | None]]:
        yield from (("estimator", self.estimator), ("task", self.task))
        named = self.pipeline
        yield "pipeline", named if isinstance(named, str) or named is None else named.get("use")
        if self.log:
            from sysid_bench.experiments import third_party

            yield from third_party.term_names((*self.choose, *(self.terms or ())))
            yield from third_party.manifest_terms(str(self.model), self.robots_dir)
            yield from third_party.reader_names((*self.log, *self.test))

    def shell(self, as_json: bool) -> int:
        from sysid_bench.commands.progress import read_progress
        from sysid_bench.commands.terminal import print_result

        with read_progress():
            try:
                result = self.run()
            except WriteError as error:
                if isinstance(error.result, Result):
                    print_result(error.result, as_json)
                raise
            print_result(result, as_json)
        failure = result.get("failure")
        if not failure:
            return OK
        accept = " --accept worse lets it pass." if self.log else ""
        click.echo(f"sysid-bench: {failure}.{accept}", err=True)
        return BAD_ANSWER


identify = python_function(Identify, "identify")
SimulatedRequest = RecordedRequest = Identify


class IdentifyCommand(Identify):  # the shell names the source of the data
    model: PathLike = model_argument("MODEL", default=None)
    simulate: bool | None = option("Data from the robot's own simulation.", default=False)

    def __post_init__(self) -> None:
        if self.model is None:
            raise UsageError(
                "Which robot? Name it or its model file, then its data: sysid-bench identify ur5 "
                "--log run.toml --test other.toml, or: sysid-bench identify ur5 --simulate."
            )
