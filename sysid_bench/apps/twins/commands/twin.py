"""Verb `twin`: a plant file with effects fitted from recordings of a robot, and its replay."""

import tempfile
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from functools import partial
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import click

from sysid_bench.commands.request import Request, logs_option, model, option
from sysid_bench.commands.result import OMIT_NONE, Result
from sysid_bench.commands.values import parse_names
from sysid_bench.errors import UsageError

if TYPE_CHECKING:
    from sysid_bench.apps.twins.fit_twin import Twin
    from sysid_bench.apps.twins.recorded_robot import RecordedRobot
    from sysid_bench.signals.log_data import LogLike

PathLike = str | Path

TRUTHS: Final = ("wls", "lmi")
"""Identified models that may be the truth: `wls` with its bodies completed near the prior, or the
feasible bodies of `lmi`, which are no smaller than the next two constants allow."""

ABOUT: Final = (
    "# Fitted from recordings of {}: the robot is {}.\n"
    "# Play it along a recorded motion: excitation = {{ use = 'file', file = ... }}.\n"
)


def figure_option() -> Any:
    """--figure of `twin` and `transfer`."""
    return option(
        "Draw the comparison: .png, .pdf or .svg.", default=None, metavar="FILE", complete="files"
    )


def jobs_option() -> Any:
    """--jobs of `twin` and `transfer`."""
    return option("Processes, of several sets.", default=1, flags="-j --jobs", least=1)


class TwinCommand(Request[Result]):
    """Fit the effects of a robot's plant from a recording, and compare its replay.

    MODEL with --log, or the name or folder of a data set. Of several sets: a table of twins and
    null twins.
    """

    models: tuple[str, ...] = model("MODEL|SET...", several=True)
    logs: tuple[Path, ...] = logs_option(
        "log", "Recording to fit; default: the training motions of the data set."
    )
    tests: tuple[Path, ...] = logs_option("test", "Recording to compare the residual on.")
    null: bool = option("No effects: noise of the same residual alone.", default=False)
    out: Path | None = option(
        "Plant file; its robot is written beside it.",
        default=None, flags="-o --out", complete="files",
    )  # fmt: skip
    figure: Path | None = figure_option()
    accept: tuple[str, ...] = option(
        "Contradictions that may pass.",
        default=(), metavar="rate,units", parse=parse_names, complete="findings", separated=True,
    )  # fmt: skip
    robots_dir: Path | None = None
    truth: str | None = option(
        "Identified model: wls with its bodies completed (default), or lmi; of several sets both.",
        default=None, choices=TRUTHS,
    )  # fmt: skip
    seed: int = option("Seed of the noise.", default=0, least=0, shown=True)
    jobs: int = jobs_option()

    def run(self) -> Result:
        """Return the twin of a robot, or the table of several data sets."""
        if len(self.models) == 1:
            return twin(
                self.models[0],
                log=self.logs,
                test=self.tests,
                truth=self.truth or "wls",
                null=self.null,
                out=self.out,
                figure=self.figure,
                seed=self.seed,
                accept=self.accept,
                robots_dir=self.robots_dir,
            )
        from sysid_bench.apps.twins.commands.twin_table import twin_table

        of_one = {
            "log": self.logs, "test": self.tests, "null": self.null, "out": self.out,
            "figure": self.figure, "accept": self.accept,
        }  # fmt: skip
        given = [f"--{key}" for key, value in of_one.items() if value]
        if given:
            raise UsageError(
                f"{', '.join(given)}: for one robot alone; of several, name data sets."
            )
        truths = TRUTHS if self.truth is None else (self.truth,)
        notice = partial(click.echo, err=True)
        return twin_table(
            self.models, truth=truths, seed=self.seed, jobs=self.jobs, progress=notice
        )


@dataclass(frozen=True, eq=False, repr=False)
class TwinResult(Result):
    """A twin, what was kept in it, and how like the robot it is.

    `joints`: for each joint the effects `kept`, with the share of the mean squared residual on
    left-out blocks that each removed, the RMS of that residual (N m, N) without and with them,
    the coefficients, and on the tests `level`, `memory` and `spectrum` (dB) of the twin's residual
    beside the robot's autocorrelation time (`seconds`) and RMS, and the share of the robot's
    residual power that the twin without noise has at the same samples, `explained` (`explained`
    of all joints is the mean). `level`: ratio of the torque errors `twin_error` and `real_error`
    of wls trained on either. None without a test.
    """

    model: str
    truth: str
    null: bool
    joints: dict[str, dict[str, Any]]
    rate: float
    draws: int
    level: float | None = None
    real_error: float | None = None
    twin_error: float | None = None
    explained: float | None = None
    plant: str | None = field(default=None, metadata=OMIT_NONE)
    robot: str | None = field(default=None, metadata=OMIT_NONE)

    def __post_init__(self) -> None:
        self._make_plain()

    def summary(self) -> str:
        """Effects kept joint by joint, and the comparison on the tests."""
        kind = "null twin" if self.null else "twin"
        lines = [
            f"{self.model}: {kind}, truth {self.truth}; residual on left-out blocks of time "
            "without -> with effects (N m, N), and the share of its power that each removed"
        ]
        for name, one in self.joints.items():
            kept = ", ".join(f"{x['effect']} {100 * x['share']:.1f} %" for x in one["kept"])
            lines.append(f"  {name:20} {one['before']:9.3g} -> {one['after']:<9.3g} {kept or '-'}")
        if self.level is not None:
            from sysid_bench.apps.twins.recorded_robot import METHOD

            lines += [
                f"  tests, not fitted, residual of {METHOD}: {kind} over recorded, {self.draws} "
                "draws of noise",
                f"  {'joint':20} {'level':>6} {'memory':>7} {'of s':>6} {'spectrum dB':>12} "
                f"{'explained':>10}",
                *(
                    f"  {name:20} {one['level']:6.2f} {one['memory']:7.2f} {one['seconds']:6.2g} "
                    f"{one['spectrum']:12.1f} {100 * one['explained']:8.1f} %"
                    for name, one in self.joints.items()
                ),
                f"  all joints: level {self.level:.2f} (error {self.twin_error:.3g} over "
                f"{self.real_error:.3g}), explained {100 * (self.explained or 0.0):.1f} %",
            ]
        if self.plant is not None:
            lines.append(f"  plant: {self.plant}; robot: {self.robot}")
        return "\n".join(lines)


def twin(
    model: str | Path,
    *,
    log: "LogLike | Sequence[LogLike]" = (),
    test: "LogLike | Sequence[LogLike]" = (),
    truth: str = "wls",
    null: bool = False,
    out: PathLike | None = None,
    figure: PathLike | None = None,
    seed: int = 0,
    accept: Sequence[str] = (),
    robots_dir: Path | None = None,
) -> TwinResult:
    """Fit the twin of a robot from recordings, or of the robot of a data set.

    The identified model (`truth`: "wls" or "lmi") has effects added that cross-validation over
    blocks of time keeps, and coloured noise of what they leave; with `null` noise alone. With tests
    its residual is compared with the recorded one. `out`: the plant file; the robot is written
    beside it. `figure`: spectra of the residuals of robot, twin and null twin. `accept`:
    contradictions in the logs that may pass.

    Raises UsageError for names, files and words that cannot be used, EstimationError where the
    robot cannot be identified or has no prior for "wls".
    """
    from sysid_bench.apps.twins.commands.identify_twin import DRAWS, identify_twin
    from sysid_bench.apps.twins.recorded_robot import recorded_set

    model, target = str(model), None if out is None else Path(out)
    if target is not None and (target.suffix.lower() != ".toml" or not target.parent.is_dir()):
        raise UsageError(f"{str(target)!r}: name a plant file *.toml in a folder that exists.")
    recorded = recorded_set(model, log, test, tuple(accept), robots_dir)
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder) / "twin.toml" if target is None else target
        found = identify_twin(recorded, truth, place, null=null)
        files = _write(found, place, model)
        if figure is not None:
            _draw(recorded, found, truth, place, Path(figure))
    # The tests took no part in the fit.
    compared = _compared(recorded, found, seed) if recorded.tests else {}
    judged = compared.pop("joints", {})
    joints = {name: _fit_fields(found, name) | judged.get(name, {}) for name in found.fits}
    more: dict[str, Any] = {**compared, **({} if target is None else files)}
    return TwinResult(recorded.manifest.name, truth, null, joints, found.rate, DRAWS, **more)


def _draw(recorded: "RecordedRobot", found: "Twin", truth: str, place: Path, picture: Path) -> None:
    """Draw the spectra of the residuals on the tests; raises UsageError without any."""
    from sysid_bench.apps.twins.commands.identify_twin import (
        identify_twin,
        replay_residual,
        residual_spectra,
    )
    from sysid_bench.apps.twins.recorded_robot import residual_of
    from sysid_bench.reporting.signal_figures import spectra_figure

    if not recorded.tests:
        raise UsageError("--figure compares residuals on tests: give --test other.toml, too.")
    # The null twin is what a twin must beat: noise of the same residual, nothing that repeats.
    null = identify_twin(recorded, truth, place.with_name("null.toml"), null=True)
    sources = {
        "recorded": residual_of(recorded.problems),
        "twin": list(chain.from_iterable(replay_residual(recorded, found, 0))),
        "null twin": list(chain.from_iterable(replay_residual(recorded, null, 0))),
    }
    spectra_figure.write(picture, residual_spectra(recorded.problems.problem.rows, sources))


def _compared(recorded: "RecordedRobot", found: "Twin", seed: int) -> dict[str, Any]:
    """Figures of all joints, and `joints` of each."""
    import numpy as np

    from sysid_bench.apps.twins.agreement import residual_ratio, torque_errors
    from sysid_bench.apps.twins.commands.identify_twin import replay_residual, twin_share
    from sysid_bench.apps.twins.recorded_robot import residual_of

    real = residual_of(recorded.problems)
    drawn = replay_residual(recorded, found, seed)
    names = recorded.problems.problem.rows
    explained = twin_share(recorded, found).tolist()
    ratios = zip(residual_ratio(real, drawn), explained, strict=True)
    each = [asdict(one) | {"explained": share} for one, share in ratios]
    own, twin_error = torque_errors(real), torque_errors([one for draw in drawn for one in draw])
    return {
        "level": twin_error / own,
        "real_error": own,
        "twin_error": twin_error,
        "explained": float(np.mean(explained)),
        "joints": dict(zip(names, each, strict=True)),
    }


def _fit_fields(found: "Twin", name: str) -> dict[str, Any]:
    """Fields of a joint's fit."""
    fit = found.fits[name]
    return {
        "kept": list(fit.kept),
        "before": fit.before,
        "after": fit.after,
        "values": fit.values,
        "shapes": {x: getattr(fit.effects, x) for x in ("width", "delay", "vs")},
    }


def _write(found: "Twin", place: Path, model: str) -> dict[str, str]:
    """Write the plant file, and the manifest of its robot with the fitted friction."""
    import tomlkit

    from sysid_bench.commands.write_model import write_text
    from sysid_bench.models.writing.manifest_writer import manifest_text

    manifest = found.robot.manifest
    robot = place.with_name(f"{place.stem}-robot.toml")
    write_text(robot, manifest_text(manifest, manifest.path.name))
    keys = {"schema": 1, "title": f"Twin of {model}", **found.plant}
    write_text(place, ABOUT.format(model, robot.name) + tomlkit.dumps(keys))
    return {"plant": str(place), "robot": str(robot)}
