"""Law: rows do not depend on the order of estimators, nor on who else is in the suite."""

import random
from pathlib import Path
from typing import Any

import pytest

from sysid_bench.harness.suite.load_suite import parse_suite
from sysid_bench.plugin_names import known
from sysid_bench.verbs.runs.run import run
from sysid_bench.words import MACHINE_FIELDS

HERE = Path(__file__).parent
ROBOTS = ("scara", "ur3", "rv2sq")
THIRD_PARTY = ("Prints", "PatchesScores", "ChangesDefaults", "WritesData", "ForksAndReturns")


def rows(robot: str, estimators: list[str], out: Path) -> dict[str, dict[str, Any]]:
    text = f"""
        schema = 1
        name = "order"
        [defaults]
        excitation = {{ use = "fourier", harmonics = 3, period = "2 s" }}
        held_out = ["ptp"]
        noise = {{ q = "1e-5 rad", tau = "1 %" }}
        prior = {{ mass = "20 %", com = "15 mm", inertia = "30 %" }}
        [[robot]]
        use = "{robot}"
        """
    text += "".join(f'\n[[estimator]]\nuse = "{use}"\n' for use in estimators)
    result = run(parse_suite(text, folder=HERE), out, jobs=2)
    return {
        row["estimator"]: {k: v for k, v in row.items() if k not in MACHINE_FIELDS}
        for row in result.folder.rows().rows.values()
    }


@pytest.mark.parametrize("seed", range(4))
def test_permutations_give_equal_rows(tmp_path: Path, seed: int) -> None:
    draw = random.Random(seed)
    robot = draw.choice(ROBOTS)
    slow = {"cloe", "clie", "rollout", "ml", "didim", "didim-guarded", "ekf", "ukf"}
    methods = draw.sample(sorted(set(known("estimator")) - slow), 7)
    methods += [f"file:{HERE / 'faulty.py'}:{name}" for name in draw.sample(THIRD_PARTY, 2)]
    first = rows(robot, methods, tmp_path / "first")
    assert len(first) == len(methods)
    for number in range(2):
        draw.shuffle(methods)
        assert rows(robot, methods, tmp_path / f"order{number}") == first
    kept = methods[::2]
    fewer = rows(robot, kept, tmp_path / "fewer")
    assert fewer == {name: first[name] for name in fewer}
