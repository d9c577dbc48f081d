"""Laws of optimised motions: shared by content, designed once, cached between workers."""

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sysid_bench.excitation.design_problem import design_problem
from sysid_bench.excitation.optimised import Optimised
from sysid_bench.experiments.simulated import commanded as motions
from sysid_bench.experiments.simulated import noise_free
from tests.closeness import assert_close
from tests.experiments.experiment_world import ready, robot_of

DESIGN = {"use": "optimised", "harmonics": 2, "period": "4 s", "iterations": 3}


@pytest.fixture
def solved(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> list[Optimised]:
    """The designs that were optimised, starting with an empty cache."""
    made: list[Optimised] = []
    solve = Optimised.solve

    def counted(self: Optimised, *words, **more):  # type: ignore[no-untyped-def]
        made.append(self)
        return solve(self, *words, **more)

    monkeypatch.setattr(Optimised, "solve", counted)
    monkeypatch.setattr(motions, "cache_folder", lambda: tmp_path / "designs")
    monkeypatch.setattr(motions, "_DESIGNS", {})
    noise_free._shared_part.cache_clear()
    return made


def test_cells_that_differ_in_noise_rate_and_payload_share_a_design(
    solved: list[Optimised], monkeypatch: pytest.MonkeyPatch
) -> None:
    first = ready(robot="ur10", excitation=DESIGN, terms=())
    again = ready(robot="ur10", excitation=DESIGN, terms=(), repeat=1, noise={"tau": 0.1})
    faster = ready(robot="ur10", excitation=DESIGN, terms=(), rate=100.0)
    assert len(solved) == 1
    motion = first.experiment.recording.q
    np.testing.assert_array_equal(motion, again.experiment.recording.q)
    assert_close(motion, faster.experiment.recording.q[::2])
    monkeypatch.setattr(motions, "_DESIGNS", {})  # another worker: only the folder is left
    kept = ready(robot="ur10", excitation=DESIGN, terms=())
    assert len(solved) == 1
    np.testing.assert_array_equal(motion, kept.experiment.recording.q)


def test_another_seed_task_or_setting_is_another_design(solved: list[Optimised]) -> None:
    ready(robot="ur10", excitation=DESIGN, terms=())
    ready(robot="ur10", excitation=DESIGN, terms=(), seed=2)
    ready(robot="ur10", excitation=DESIGN, terms=("viscous",))
    ready(robot="ur10", excitation={**DESIGN, "objective": "cond"}, terms=())
    assert len(solved) == 4


def test_content_is_what_is_held_and_not_the_rate() -> None:
    problem = design_problem(robot_of("ur5"), 100.0)
    same = design_problem(robot_of("ur5"), 200.0)
    assert motions.design_key(problem) == motions.design_key(same)
    assert motions.design_key(problem) != motions.design_key(replace(same, v=1.01 * same.v))
    assert motions.design_key(problem) != motions.design_key(
        design_problem(robot_of("ur10"), 100.0)
    )


def test_a_damaged_file_is_made_again(solved: list[Optimised], tmp_path: Path) -> None:
    ready(robot="ur10", excitation=DESIGN, terms=())
    for file in (tmp_path / "designs").iterdir():
        file.write_bytes(file.read_bytes()[:20])
    motions._DESIGNS.clear()
    noise_free._shared_part.cache_clear()
    ready(robot="ur10", excitation=DESIGN, terms=())
    assert len(solved) == 2


def test_a_stored_design_is_the_whole_one_or_none(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(motions, "cache_folder", lambda: tmp_path)
    C = np.arange(6.0).reshape(2, 3)
    motions._write_design("key", C)
    (file,) = tmp_path.iterdir()
    np.testing.assert_array_equal(motions._read_design("key"), C)
    content = file.read_bytes()
    for place in range(len(content)):
        file.write_bytes(content[:place] + bytes([content[place] ^ 1]) + content[place + 1 :])
        assert motions._read_design("key") is None
    file.unlink()
    os.mkfifo(file)
    assert motions._read_design("key") is None
