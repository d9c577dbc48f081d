"""Twin of a recorded robot: a plant file with effects fitted from its recordings."""

import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from itertools import chain
from pathlib import Path
from typing import Any, Final

import numpy as np
import tomlkit

from sysid_bench.apps.twins.fit_twin import Twin, fit_twin
from sysid_bench.apps.twins.recorded_robot import METHOD, Posed, RecordedRobot, residual_of
from sysid_bench.apps.twins.residual_figures import (
    Residual,
    residual_ratio,
    residual_share,
    torque_errors,
)
from sysid_bench.commands.recorded_model import ENTROPIC, WAY_ON, write_recorded_model
from sysid_bench.commands.result import OMIT_NONE, Result
from sysid_bench.commands.write_model import SUFFIXES, write_text
from sysid_bench.errors import EstimationError, ModelError, UsageError, unknown_name
from sysid_bench.identification.estimators.feasible import LMI
from sysid_bench.identification.identify import identify
from sysid_bench.models.load import load_robot
from sysid_bench.models.manifest import find_manifest
from sysid_bench.models.robot import RobotModel
from sysid_bench.models.writing.manifest_writer import manifest_text
from sysid_bench.plugin_names import build
from sysid_bench.reporting.signal_figures import spectra_figure
from sysid_bench.signals.log_data import LogLike
from sysid_bench.types import Array, Estimate
from sysid_bench.verbs.recorded.recorded_set import RecordedChoice, recorded_set
from sysid_bench.verbs.recorded.twin_spectra import residual_spectra

PathLike = str | Path

TRUTHS: Final = ("wls", "lmi")
"""Identified models that may be the truth: `wls` with its bodies completed near the prior, or the
feasible bodies of `lmi`, which are no smaller than the next two constants allow."""

LEAST_MASS: Final = 0.005
"""Smallest mass of a body of `lmi`, over that of the heaviest link in the model file. The program
alone leaves bodies without mass, which no simulation can follow."""

LEAST_ROUNDNESS: Final = 1e-3
"""Margin of `lmi`: smallest eigenvalue of a pseudo-inertia over its trace, in the units of length
of the program."""

DRAWS: Final = 5
"""Draws of a twin's noise."""

ROUNDS: Final = 3
"""Times, at most, that the bodies are identified again beside the effects."""

ABOUT: Final = (
    "# Fitted from recordings of {}: the robot is {}.\n"
    "# Play it along a recorded motion: excitation = {{ use = 'file', file = ... }}.\n"
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
            "without -> with effects (N m, N), and the share of its power that each removed",
            *(_kept_line(name, joint) for name, joint in self.joints.items()),
        ]
        if self.level is not None:
            lines += self._test_lines(kind)
        if self.plant is not None:
            lines.append(f"  plant: {self.plant}; robot: {self.robot}")
        return "\n".join(lines)

    def _test_lines(self, kind: str) -> list[str]:
        return [
            f"  tests, not fitted, residual of {METHOD}: {kind} over recorded, {self.draws} "
            "draws of noise",
            f"  {'joint':20} {'level':>6} {'memory':>7} {'of s':>6} {'spectrum dB':>12} "
            f"{'explained':>10}",
            *(_test_line(name, joint) for name, joint in self.joints.items()),
            f"  all joints: level {self.level:.2f} (error {self.twin_error:.3g} over "
            f"{self.real_error:.3g}), explained {100 * (self.explained or 0.0):.1f} %",
        ]


def _kept_line(name: str, joint: Mapping[str, Any]) -> str:
    kept = [f"{one['effect']} {100 * one['share']:.1f} %" for one in joint["kept"]]
    return f"  {name:20} {joint['before']:9.3g} -> {joint['after']:<9.3g} {', '.join(kept) or '-'}"


def _test_line(name: str, joint: Mapping[str, Any]) -> str:
    return (
        f"  {name:20} {joint['level']:6.2f} {joint['memory']:7.2f} {joint['seconds']:6.2g} "
        f"{joint['spectrum']:12.1f} {100 * joint['explained']:8.1f} %"
    )


def twin(
    model: str | Path,
    *,
    log: LogLike | Sequence[LogLike] = (),
    test: LogLike | Sequence[LogLike] = (),
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
    model, target = str(model), None if out is None else _checked_target(Path(out))
    recorded = recorded_set(RecordedChoice(model, log, test, tuple(accept), robots_dir))
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder) / "twin.toml" if target is None else target
        found = identify_twin(recorded, truth, place, null=null)
        files = _write(found, place, model)
        if figure is not None:
            _draw(recorded, found, truth, place, Path(figure))
    compared = _compared(recorded, found, seed) if recorded.tests else {}
    judged = compared.pop("joints", {})
    joints = {name: _fit_fields(found, name) | judged.get(name, {}) for name in found.fits}
    more: dict[str, Any] = {**compared, **({} if target is None else files)}
    return TwinResult(recorded.manifest.name, truth, null, joints, found.rate, DRAWS, **more)


def _draw(recorded: RecordedRobot, found: Twin, truth: str, place: Path, picture: Path) -> None:
    """Draw the spectra of the residuals on the tests; raises UsageError without any."""
    if not recorded.tests:
        raise UsageError("--figure compares residuals on tests: give --test other.toml, too.")
    null = identify_twin(recorded, truth, place.with_name("null.toml"), null=True)
    sources = {
        "recorded": residual_of(recorded.problems),
        "twin": list(chain.from_iterable(replay_residual(recorded, found, 0))),
        "null twin": list(chain.from_iterable(replay_residual(recorded, null, 0))),
    }
    spectra_figure(picture, residual_spectra(recorded.problems.problem.rows, sources))


def _checked_target(out: Path) -> Path:
    """The plant file; raises UsageError for another suffix and a folder that is not there."""
    if out.suffix.lower() != ".toml" or not out.parent.is_dir():
        raise UsageError(f"{str(out)!r}: name a plant file *.toml in a folder that exists.")
    return out


def identify_twin(recorded: RecordedRobot, truth: str, place: Path, *, null: bool = False) -> Twin:
    """Return the twin, or the null twin, of a robot with the model identified by `truth`, whose
    file is written beside a plant file.

    The bodies are identified again without the torque of the kept effects, so that neither takes up
    what belongs to the other, while left-out blocks are predicted better. Raises UsageError,
    EstimationError and ModelError as `twin`.
    """
    source = recorded.problems.source
    groups, preprocessing = () if null else None, source.builder.preprocessing
    robot = identify_robot(recorded.problems, truth, place)
    found = fit_twin(robot, source.training, preprocessing, groups)
    for _ in range(ROUNDS):
        if not any(fit.kept for fit in found.fits.values()):
            break
        robot = identify_robot(recorded.without_effects(found), truth, place)
        again = fit_twin(robot, source.training, preprocessing, groups)
        if again.left_out_residual >= found.left_out_residual:
            break
        found = again
    return found


def identify_robot(posed: Posed, truth: str, place: Path) -> RobotModel:
    """Return the identified model of a problem, whose file is written beside a plant file, with the
    joints locked that no log lists."""
    if truth not in TRUTHS:
        raise unknown_name("truth of a twin", truth, TRUTHS)
    locked = posed.source.training[0].robot
    method = build("estimator", truth) if truth != "lmi" else _lmi_of_bodies(locked)
    estimate = identify(method, posed.problem, posed.experiment)
    target = place.with_name(f"{place.stem}-robot{SUFFIXES[locked.format][0]}")
    manifest = find_manifest(_written(posed, estimate, target, truth))
    # The seeds of a replay are those of the robot that was asked for, not of a written file.
    own = locked.manifest
    return load_robot(replace(manifest, locked=own.locked, content=own.content))


def _written(posed: Posed, estimate: Estimate, target: Path, truth: str) -> str:
    """Path of the manifest of the written model; where it is refused, advise another truth."""
    distance = ENTROPIC if truth == "wls" else None
    try:
        return write_recorded_model(posed, estimate, target, distance).manifest
    except (EstimationError, ModelError) as error:
        if truth == "lmi":
            raise
        reason = str(error).removesuffix(WAY_ON).strip()
        raise type(error)(f"{reason} --truth lmi needs no prior.") from error


def _lmi_of_bodies(robot: RobotModel) -> LMI:
    """`lmi` whose bodies have a size and a mass."""
    return LMI(margin=LEAST_ROUNDNESS, mass=(LEAST_MASS * robot.phi[:, 0].max(), np.inf))


def replay_residual(recorded: RecordedRobot, found: Twin, seed: int) -> list[list[Residual]]:
    """Return the residuals of METHOD on replays of the tests, trained on replays of the training
    logs, for each of DRAWS draws of noise."""
    return [
        residual_of(recorded.replay(found.replay_plant, found.rate, DRAWS * seed + k))
        for k in range(DRAWS)
    ]


def twin_share(recorded: RecordedRobot, found: Twin) -> Array:
    """Return the share (n,) of the recorded residual of METHOD on the tests, joint by joint, that a
    replay without coloured noise has, too (`residual_share`)."""
    replayed = recorded.replay(found.noise_free_plant, found.rate, 0)
    return residual_share(residual_of(recorded.problems), residual_of(replayed))


def _compared(recorded: RecordedRobot, found: Twin, seed: int) -> dict[str, Any]:
    """Figures of all joints, and `joints` of each."""
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


def _fit_fields(found: Twin, name: str) -> dict[str, Any]:
    """Fields of a joint's fit."""
    fit = found.fits[name]
    shapes = {"width": fit.effects.width, "delay": fit.effects.delay, "vs": fit.effects.vs}
    return {
        "kept": [asdict(one) for one in fit.kept],
        "before": fit.before,
        "after": fit.after,
        "values": fit.values,
        "shapes": shapes,
    }


def _write(found: Twin, place: Path, model: str) -> dict[str, str]:
    """Write the plant file, and the manifest of its robot with the fitted friction."""
    manifest = found.robot.manifest
    robot = place.with_name(f"{place.stem}-robot.toml")
    write_text(robot, manifest_text(manifest, manifest.path.name))
    keys = {"schema": 1, "title": f"Twin of {model}", **found.plant}
    write_text(place, ABOUT.format(model, robot.name) + tomlkit.dumps(keys))
    return {"plant": str(place), "robot": str(robot)}
