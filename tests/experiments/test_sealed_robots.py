"""Laws of sealed robots: feasible bodies around the file, whose parameters are the prior."""

import hashlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sysid_bench.experiments.execute import load_experiment, prepare
from sysid_bench.experiments.simulated.sealed_robot import robot_of_plant
from sysid_bench.experiments.spec import SEEDS
from sysid_bench.harness.plan import cells_of_suite
from sysid_bench.harness.run import job_of
from sysid_bench.harness.suite.load_suite import parse_suite
from sysid_bench.spatial import body_mass_inertia
from tests.robots import named_robot

SECRETS = ("0123456789abcdef" * 4, "fedcba9876543210" * 4)
SIGNALS = '{ filter = "none", derivatives = "exact" }'


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    (tmp_path / "seeds.txt").write_text("\n".join(SECRETS))
    for k, secret in enumerate(SECRETS):
        seal = hashlib.sha256(secret.encode()).hexdigest()
        text = f'schema = 1\nsealed = "{seal}"\neffects = []\n'
        (tmp_path / f"sealed{k}.toml").write_text(text)
    monkeypatch.setenv(SEEDS, str(tmp_path / "seeds.txt"))
    return tmp_path


def prepared(folder: Path, robot: str, more: str = "") -> list[Any]:
    text = f"""
        schema = 1
        name = "sealed"
        [defaults]
        excitation = {{ use = "fourier", harmonics = 3, period = "2 s" }}
        held_out = ["ptp"]
        signals = {SIGNALS}
        plant = ["file:sealed0.toml", "file:sealed1.toml"]
        {more}
        [[robot]]
        use = "{robot}"
        [[estimator]]
        use = "ols"
        """
    suite = parse_suite(text, folder=folder)
    cells = cells_of_suite(suite).cells
    return [(c.spec, prepare(*load_experiment(job_of([c], suite, None)))) for c in cells]


@pytest.mark.parametrize("robot", ["scara", "ur5", "panda"])
def test_the_truth_is_around_the_file_and_the_prior_is_the_file(folder: Path, robot: str) -> None:
    model = named_robot(robot)
    truths = []
    for spec, data in prepared(folder, robot):
        problem, truth = data.problem, data.source.truth
        of_file = dict(zip(model.inertial_columns, model.phi.ravel(), strict=True))
        prior = dict(zip(problem.parameters, problem.prior.theta, strict=True))
        assert all(prior[name] == value for name, value in of_file.items() if name in prior)
        truths.append(truth.theta)
        off = (truth.theta - problem.prior.theta) / problem.prior.std
        assert 0.3 < np.sqrt(np.mean(off**2)) < 3.0
        for phi in robot_of_plant(spec, model, problem.parameters).phi:
            mass, _, inertia = body_mass_inertia(phi)
            if mass > 0:
                moments = np.linalg.eigvalsh(inertia)
                assert moments[0] > 0
                assert moments[0] + moments[1] > moments[2] * (1 - 1e-9)
        # Exact data of the drawn robot determine its parameters, not those of the file.
        beta = np.linalg.lstsq(problem.W, problem.b, rcond=None)[0]
        K = problem.base.K
        np.testing.assert_allclose(beta, K @ truth.theta, rtol=1e-6, atol=1e-8)
        assert np.linalg.norm(K @ (problem.prior.theta - truth.theta)) > 1e-2
    assert not np.allclose(*truths)


def test_bodies_are_the_same_for_all_payloads(folder: Path) -> None:
    (spec, _), _ = prepared(folder, "ur5")
    loaded = named_robot("ur5", "box-2kg")
    bare = robot_of_plant(spec, named_robot("ur5"), loaded.inertial_columns)
    loaded = robot_of_plant(spec, loaded, loaded.inertial_columns)
    for name, phi in zip(bare.body_names, bare.phi, strict=True):
        np.testing.assert_array_equal(phi, loaded.phi[loaded.body_names.index(name)])


def test_known_parts_of_a_task_are_those_of_the_file(folder: Path) -> None:
    for _, data in prepared(folder, "ur5", 'task = "terminal"'):
        task, robot = data.source.task, named_robot("ur5")
        of_file = robot.tree.link_parameters(robot.phi)
        known = [k for k, phi in enumerate(task.known_links) if phi.any()]
        assert known
        np.testing.assert_array_equal(task.known_links[known], of_file[known])
        beta = np.linalg.lstsq(data.problem.W, data.problem.b, rcond=None)[0]
        truth = data.problem.base.K @ data.source.truth.theta
        np.testing.assert_allclose(beta, truth, rtol=1e-6, atol=1e-8)
