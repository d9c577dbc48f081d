"""Recordings of the task `actuators` in suites: fits, published values, and their rollouts."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import sysid_bench
from sysid_bench.apps.actuators.commands.actuators_result import ActuatorsResult
from sysid_bench.apps.actuators.drive_experiment import prepare_drives
from sysid_bench.errors import UsageError
from sysid_bench.experiments.experiment_data import ExperimentData
from sysid_bench.harness.run import run
from sysid_bench.harness.stored_run import RunFolder
from sysid_bench.harness.suite.load_suite import load_suite
from sysid_bench.identification.estimators.bayesian import PriorMean
from sysid_bench.identification.estimators.feasible import Bounded
from sysid_bench.identification.identify import identify
from sysid_bench.models.manifest import find_manifest
from sysid_bench.signals.log_description import log_description, read_description
from tests.actuators.leg import JOINTS, MODEL, RATE, Case

CASE = Case(3, delay=0.005, seconds=8.0, more=(("bias", 0.02),))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording in a file, with the truth as its published values."""
    folder = tmp_path_factory.mktemp("published")
    (folder / "leg.xml").write_text(MODEL, encoding="utf-8")
    commands = CASE.commands()
    arrays = {name: getattr(commands, name) for name in ("q", "q_des", "kp", "kd")}
    np.savez(folder / "run.npz", allow_pickle=False, **arrays)
    (folder / "run.toml").write_text(
        f'file = "run.npz"\nrate = "{RATE:g} Hz"\njoints = {json.dumps(JOINTS)}\n'
        'q = { columns = "q" }\n'
        'tau = { pd = { q_des = "q_des", kp = "kp", kd = "kd", delay = "3 ms" } }\n',
        encoding="utf-8",
    )
    words = ("armature", "damping", "frictionloss")
    joints = {
        joint: {**dict(zip(words, row.tolist(), strict=False)), "bias": 0.02}
        for joint, row in zip(JOINTS, CASE.values, strict=True)
    }
    other = {joint: {**one, "bias": -0.02} for joint, one in joints.items()}
    heavy = {joint: {**one, "armature": 0.2} for joint, one in joints.items()}
    text = {name: {"joints": of} for name, of in
            (("truth", joints), ("other-sign", other), ("heavy", heavy))}  # fmt: skip
    (folder / "published.json").write_text(json.dumps({"units": "SI", **text}), encoding="utf-8")
    return folder


PROFILE = {"use": "run.toml", "tau": {"pd": {"delay": "profile"}}}


def prepared(folder: Path, prior: str = "model", log: Any = PROFILE) -> ExperimentData[Any]:
    manifest = find_manifest(str(folder / "leg.xml"))
    return prepare_drives(manifest, [log_description(log, folder)], {}, (), prior)


def scores(of: ExperimentData[Any], method: Any) -> dict[str, Any]:
    return of.score(method, identify(method, of.problem, of.experiment))


def test_a_suite_and_the_command_answer_alike(folder: Path) -> None:
    of = prepared(folder)
    found = scores(of, Bounded())
    result = sysid_bench.identify(
        folder / "leg.xml", task="actuators", log=log_description(PROFILE, folder)
    )
    assert isinstance(result, ActuatorsResult)
    assert of.fields["log"]["delay"] == pytest.approx(result.delay, abs=1e-9)
    assert found["rollout_error"] == pytest.approx(result.rollout_error, rel=1e-3)
    for row in found["parameters_table"]:
        value = result.joints[row["body"]][row["name"]]
        assert row["estimate"] == pytest.approx(value, rel=1e-3, abs=1e-5)


def test_published_values_are_judged_with_their_bias(folder: Path) -> None:
    errors = {
        name: scores(prepared(folder, f"published:{name}"), PriorMean())["rollout_error"]
        for name in ("truth", "other-sign", "heavy")
    }
    assert errors["truth"] == pytest.approx(errors["other-sign"])
    assert errors["heavy"] > 3.0 * errors["truth"]


def test_a_stated_delay_is_kept_and_a_key_alone_is_replaced(folder: Path) -> None:
    assert prepared(folder, log="run.toml").fields["log"]["delay"] == pytest.approx(0.003)
    written = read_description(folder / "run.toml").tau.pd
    changed = log_description(PROFILE, folder).tau.pd
    assert written is not None
    assert changed == replace_delay(written)


def replace_delay(pd: Any) -> Any:
    """The controller with an unknown delay, and all else as it is."""
    return pd.model_copy(update={"delay": "profile"})


@pytest.mark.parametrize(
    ("prior", "words"), [("published:trth", "Did you mean 'truth'"), ("mine", "No prior")]
)
def test_values_that_nobody_published_are_refused(folder: Path, prior: str, words: str) -> None:
    with pytest.raises(UsageError, match=words):
        prepared(folder, prior)


def test_tests_are_judged_behind_the_share_of_the_training(folder: Path) -> None:
    log = replace(log_description(PROFILE, folder), share=0.5)
    manifest = find_manifest(str(folder / "leg.xml"))
    of = prepare_drives(manifest, [log], {"again": log_description(PROFILE, folder)}, (), "none")
    assert of.source.training[0].rows == slice(0, 800)
    assert of.source.tests["again"].rows == slice(800, 1540)


OWN_TASK = """
from dataclasses import dataclass, replace

from sysid_bench.apps.actuators.task import ActuatorsTask


@dataclass(frozen=True)
class FirstHalf(ActuatorsTask):
    \"\"\"Actuators from the first half of each recording.\"\"\"

    def prepare_recordings(self, manifest, training, tests, accept, prior):
        half = [replace(log, share=0.5) for log in training]
        return super().prepare_recordings(manifest, half, tests, accept, prior)
"""


def test_a_task_of_others_prepares_its_own_recordings_in_a_suite(folder: Path) -> None:
    (folder / "own.py").write_text(OWN_TASK, encoding="utf-8")
    logs = "".join(
        f'[[log]]\nrobot = "leg.xml"\ntrain = ["run.toml"]\ntask = "{task}"\n'
        for task in ("file:own.py:FirstHalf", "actuators")
    )
    text = f'schema = 1\nname = "own"\n{logs}[[estimator]]\nuse = "bounded"\n'
    (folder / "own.toml").write_text(text, encoding="utf-8")
    run(load_suite(folder / "own.toml"), folder / "own", jobs=1)
    rows = [*RunFolder.open(folder / "own").rows().rows.values()]
    own, whole = sorted(rows, key=lambda row: "file:" not in row["task"])
    assert own["status"] == whole["status"] == "ok", (own["reason"], whole["reason"])
    # The stated delay is a field of actuators alone.
    assert own["log"]["delay"] == whole["log"]["delay"] == pytest.approx(0.003)
    assert own["rmse_train"] != whole["rmse_train"]
