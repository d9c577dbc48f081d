"""Plant files: levels as data, expanded when a suite is read; candidates apart from plants."""

from pathlib import Path
from typing import Any

import pytest

from sysid_bench import list_, package_folders, show, table
from sysid_bench.errors import UsageError
from sysid_bench.experiments.simulated.composed_plant import composed_plant
from sysid_bench.harness.plan import cells_of_suite
from sysid_bench.harness.run import run
from sysid_bench.harness.suite.load_suite import parse_suite, suite_text
from sysid_bench.harness.suite.plugin_entries import read_plant
from sysid_bench.simulation.candidate import Candidate
from sysid_bench.simulation.tracking_control import TrackingControl

SUITE = """
schema = 1
name = "levels"
estimator = [{ use = "wls" }, { use = "cloe" }]
[defaults]
plant = PLANT
prior = "none"
rate = "100 Hz"
excitation = { use = "fourier", period = "2 s", cycles = 1 }
candidate = CANDIDATE
[[robot]]
use = "scara"
[[table]]
name = "error"
rows = ["estimator"]
columns = ["plant"]
cells = { metric = "torque_error" }
"""

MINE = """
schema = 1
title = "Mine"
simulation = { use = "closed-loop", rate = "500 Hz" }
noise = { tau = "2 %" }
effects = [{ use = "stribeck", share = "5 %" }]
"""


def suite_of(plant: str, candidate: str = "{}", folder: Path | None = None) -> Any:
    text = SUITE.replace("PLANT", plant).replace("CANDIDATE", candidate)
    return parse_suite(text, folder=folder)


@pytest.mark.parametrize("name", sorted(package_folders.plant_files()))
def test_every_level_is_a_plant_that_can_be_shown_copied_and_planned(
    name: str, tmp_path: Path
) -> None:
    copy = tmp_path / "copy.toml"
    copy.write_text(package_folders.plant_files()[name].read_text(encoding="utf-8"))
    assert show(name)["title"] == read_plant(copy)["title"]
    assert name in [entry["name"] for entry in list_("plants")]
    by_name, by_file = suite_of(f'"{name}"'), suite_of('"file:copy.toml"', folder=tmp_path)
    (level,), (copied,) = by_name.defaults.plant, by_file.defaults.plant
    assert copied.spec == {**level.spec, "name": "copy"}
    assert composed_plant(level.spec)
    (cell, _) = cells_of_suite(by_name).cells
    assert cell.labels["plant"] == name


def test_a_plant_file_is_read_once_and_its_keys_hold(tmp_path: Path) -> None:
    file = tmp_path / "mine.toml"
    file.write_text(MINE)
    suite = suite_of('["matched", "file:mine.toml"]', folder=tmp_path)
    file.unlink()
    again = parse_suite(suite_text(suite), folder=tmp_path)
    assert again == suite
    cells = cells_of_suite(again).cells
    assert [cell.labels["plant"] for cell in cells] == ["matched", "matched", "mine", "mine"]
    spec = cells[-1].spec
    assert spec.simulation == {"use": "closed-loop", "rate": "500 Hz"}
    assert spec.noise == {"tau_relative": 0.02}
    assert spec.plant["effects"] == [{"use": "stribeck", "share": "5 %"}]
    assert cells[0].spec.simulation == {"use": "inverse"}
    assert cells[0].spec.noise == {}


def test_keys_beside_the_name_replace_those_of_the_file(tmp_path: Path) -> None:
    (tmp_path / "mine.toml").write_text(MINE)
    suite = suite_of('{ use = "file:mine.toml", noise = {}, effects = [] }', folder=tmp_path)
    (cell, _) = cells_of_suite(suite).cells
    assert cell.spec.noise == {}
    assert cell.spec.plant["effects"] == []
    assert cell.spec.simulation["rate"] == "500 Hz"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("schema = 2", "schema = 2"),
        ("schema = 1\neffect = []", "effects"),
        ("schema = 1\neffects = [{ use = 'stribek' }]", "stribeck"),
        ("schema = 1\nnoise = { tua = '1 %' }", "tau"),
        ("schema = 1\nsimulation = 'closedloop'", "closed-loop"),
        ("schema = ", "cannot be read"),
    ],
)
def test_a_mistake_in_a_plant_file_is_one_error(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "mine.toml").write_text(text)
    with pytest.raises(UsageError, match=message):
        suite_of('"file:mine.toml"', folder=tmp_path)


OWN_WORDS = """
from dataclasses import dataclass

@dataclass
class Loud:
    noise: float = 0.1
    def __call__(self, robot):
        return None
"""


@pytest.mark.parametrize(
    "plant", ['"file:mine.py:Loud"', '{ use = "file:mine.py:Loud", noise = 0.2 }']
)
def test_an_effect_cannot_use_the_words_of_plants(tmp_path: Path, plant: str) -> None:
    (tmp_path / "mine.py").write_text(OWN_WORDS)
    with pytest.raises(UsageError, match=r"'noise' is a key of plants.*call the setting otherwise"):
        suite_of(plant, folder=tmp_path)


def test_an_absent_plant_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"absent\.toml"):
        suite_of('"file:absent.toml"', folder=tmp_path)


@pytest.mark.parametrize("plant", ['"L9"', '["matched", { use = "L9", noise = {} }]'])
def test_an_unknown_plant_is_answered_with_plant_files_too(plant: str) -> None:
    with pytest.raises(UsageError, match=r"No plant is called 'L9'\. Did you mean 'L") as refusal:
        suite_of(plant)
    for name in ("L0", "L1", "L2", "L3", "L4"):
        assert name in str(refusal.value)


@pytest.mark.long
def test_one_simulator_for_plant_and_candidates_is_stated_below_tables(tmp_path: Path) -> None:
    plants = '{ use = "L1", sensors = [], simulation = { use = "closed-loop", substeps = 2 } }'
    notes = {}
    for step in ("0.5 ms", "1 ms"):
        suite = suite_of(plants, f'{{ step = "{step}" }}')
        folder = tmp_path / step.replace(" ", "")
        run(suite, folder, jobs=1, select='estimator == "wls"')
        notes[step] = table(folder, "error")
    assert "share step and integrator, or the simulator, in 1 of 1 cells" in notes["0.5 ms"]
    assert "share step" not in notes["1 ms"]


def test_simulators_are_one_where_the_steps_that_are_taken_are_equal() -> None:
    """Internal springs of a plant take more steps than `substeps`."""
    plant, fine = TrackingControl(substeps=4), Candidate(step=0.25e-3)
    assert fine.has_steps_of(plant, 0.25e-3)
    assert not fine.has_steps_of(plant, 0.05e-3)
    assert not Candidate().has_steps_of(plant, 0.25e-3)
    assert fine.has_steps_of(TrackingControl(integrator="euler"), 0.25e-3)
    assert not Candidate(0.25e-3, "rk4").has_steps_of(TrackingControl(integrator="euler"), 0.25e-3)


def test_a_candidate_step_divides_the_control_period() -> None:
    assert Candidate(step=0.25e-3).control(1000.0).substeps == 4
    assert Candidate().control(500.0).substeps == 1
    for step in (0.3e-3, 2e-3):
        with pytest.raises(UsageError, match="divide"):
            Candidate(step=step).control(1000.0)
