"""Twin of a recorded robot with the model that a method identifies, and its residual on replays."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np
from scipy.signal import welch

from sysid_bench.apps.twins.agreement import HIGHEST, LOWEST, SEGMENT, Residual, residual_share
from sysid_bench.apps.twins.commands.twin import TRUTHS
from sysid_bench.apps.twins.fit_twin import Twin, fit_twin
from sysid_bench.apps.twins.recorded_robot import Posed, RecordedRobot, residual_of
from sysid_bench.commands.recorded_model import ENTROPIC, WAY_ON, write_recorded_model
from sysid_bench.commands.write_model import SUFFIXES
from sysid_bench.errors import EstimationError, ModelError, unknown_name
from sysid_bench.identification.estimators.feasible import LMI
from sysid_bench.identification.identify import identify
from sysid_bench.models.load import load_robot
from sysid_bench.models.manifest import find_manifest
from sysid_bench.models.model_record import seed_content
from sysid_bench.models.robot import RobotModel
from sysid_bench.plugin_names import build
from sysid_bench.reporting.signal_figures import ResidualSpectra
from sysid_bench.types import Array

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

POINTS: Final = 60
"""Frequencies of a spectrum, evenly spaced in their logarithm."""


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
        # Bodies and effects can take up each other's torque: left-out blocks tell when a further
        # round only moves it.
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
    method = build("estimator", truth)
    if truth == "lmi":  # bodies that have a size and a mass
        method = LMI(margin=LEAST_ROUNDNESS, mass=(LEAST_MASS * locked.phi[:, 0].max(), np.inf))
    estimate = identify(method, posed.problem, posed.experiment)
    target = place.with_name(f"{place.stem}-robot{SUFFIXES[locked.format][0]}")
    distance = ENTROPIC if truth == "wls" else None
    try:
        written = write_recorded_model(posed, estimate, target, distance).manifest
    except (EstimationError, ModelError) as error:
        if truth == "lmi":
            raise
        reason = str(error).removesuffix(WAY_ON).strip()
        raise type(error)(f"{reason} --truth lmi needs no prior.") from error
    # The seeds of a replay are those of the robot that was asked for, not of a written file.
    own = locked.manifest
    manifest = replace(find_manifest(written), locked=own.locked, by_path=own.by_path)
    return load_robot(replace(manifest, content=seed_content(own)))


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


def residual_spectra(
    joints: Sequence[str], residuals: Mapping[str, Sequence[Residual]]
) -> ResidualSpectra:
    """Return the spectra of each source, averaged over its tests and draws."""
    f = np.geomspace(LOWEST, HIGHEST, POINTS)
    densities = {}
    for source, several in residuals.items():
        each = []
        for one in several:
            samples = min(len(one.e), round(SEGMENT * one.rate))
            own, density = welch(one.e, one.rate, nperseg=samples, axis=0)
            # Without f = 0: it has no place on a logarithmic axis, and the mean of each segment is
            # removed.
            columns = [np.interp(f, own[1:], column[1:]) for column in density.T]
            each.append(np.maximum(np.column_stack(columns), 1e-30))
        densities[source] = np.asarray(np.mean(each, axis=0))
    return ResidualSpectra(tuple(joints), f, densities)
