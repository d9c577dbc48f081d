"""Data sets: the named ones are complete, and a folder of one's own works wherever a name does."""

import json
import os
import re
from collections.abc import Hashable
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

import sysid_bench
from sysid_bench import package_folders
from sysid_bench.apps.clusters.batch import with_folders
from sysid_bench.commands.main import main
from sysid_bench.errors import UsageError
from sysid_bench.experiments.execute import load_experiment
from sysid_bench.harness.plan import cells_of_suite
from sysid_bench.harness.run import job_of
from sysid_bench.harness.suite.load_suite import parse_suite
from sysid_bench.harness.suite.model import Suite
from sysid_bench.models.data_sets import find_dataset
from sysid_bench.models.load import load_robot
from sysid_bench.models.manifest import find_manifest
from sysid_bench.signals.log import read_log
from sysid_bench.signals.log_description import (
    description_of,
    log_description,
    read_description,
)

NAMES = sorted(package_folders.dataset_files())
DATA = os.environ.get("SYSID_BENCH_DATA")
SUITE = """
schema = 1
name   = "mine"
[[log]]
dataset = {source}
{keys}
[[estimator]]
use = "ols"
"""
PAYLOAD = '[[payload]]\nempty = "monday"\n{}\n[log]'
ROBOT = "toml: robot: must be a name, or a table with the keys of a robot.toml"


@pytest.mark.parametrize("name", NAMES)
def test_a_named_set_states_what_others_need(name: str) -> None:
    found = find_dataset(name)
    described = found.described
    assert described.name == name
    assert described.origin
    assert re.fullmatch("[0-9a-f]{40}", described.commit)
    assert described.title
    assert described.train
    assert described.test
    assert described.file
    text = found.file.read_text()
    assert not re.search(r'"(/|~|\$)', text), "a path of a machine"
    if described.is_open:
        assert described.url.endswith(described.commit)
    # Descriptions are complete but for the places of files.
    for motion, keys in described.motions.items():
        description_of({**described.log, "file": "x.csv", **keys}, Path(motion))


def test_sets_are_listed_and_shown() -> None:
    listed = {entry["name"] for entry in sysid_bench.list_("datasets")}
    assert listed == set(NAMES)
    shown = sysid_bench.show("ur10e")
    assert shown["licence"] == "none"
    assert shown["missing"]
    assert sysid_bench.show("dataset:ur10")["kind"] == "dataset"


@pytest.mark.data
@pytest.mark.parametrize("name", NAMES)
def test_a_named_set_is_that_of_its_hashes(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    if DATA is None:
        pytest.skip("SYSID_BENCH_DATA is not set")
    monkeypatch.setenv("SYSID_BENCH_DATA", DATA)
    result = sysid_bench.fetch(name)
    assert result.files.keys() == {file.path for file in find_dataset(name).described.file}
    robot = find_manifest(f"dataset:{name}")
    first = find_dataset(name).described.train[0]
    log = read_description(Path(f"dataset:{name}/{first}"))
    assert set(log.joints) - {"-"} <= set(load_robot(robot).rows)


def test_a_missing_set_says_how_to_get_it() -> None:
    with pytest.raises(UsageError, match="sysid-bench fetch ur10e"):
        read_description(Path("dataset:ur10e/fourier-30s"))
    with pytest.raises(UsageError, match="sysid-bench fetch ur10e"):
        find_manifest("dataset:ur10e")


@pytest.mark.parametrize(
    ("source", "said"),
    [
        ("ur10x", "Did you mean|nearest"),
        ("file:./absent", "not a data set"),
        ("./absent", "not a data set"),
    ],
)
def test_an_unknown_set_is_named(source: str, said: str) -> None:
    with pytest.raises(UsageError, match=said):
        sysid_bench.fetch(source)


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ('train   = ["monday"]', 'train   = ["sunday"]', "motion"),
        ('test    = ["tuesday"]', 'test    = ["monday"]', "in train and in test"),
        ('split   = "another day"', 'split   = "other"', "another motion"),
        ("title ", "titel ", "titel"),
        ('name    = "mine"\n', "", "name is missing"),
        (
            '[robot]\nfile  = "arm.xml"\nterms = ["viscous", "coulomb"]',
            "robot = 5",
            f"{ROBOT}; got 5.$",
        ),
        (
            "[log]",
            PAYLOAD.format('loadd = "tuesday"'),
            "mean 'loaded'. There are: empty, loaded, mass",
        ),
        ("[log]", PAYLOAD.format('loaded = "tuesday"\nmass = inf'), "mass: .*finite"),
    ],
)
def test_a_mistake_is_one_sentence(own_set: Path, old: str, new: str, said: str) -> None:
    file = own_set / "dataset.toml"
    file.write_text(file.read_text().replace(old, new))
    with pytest.raises(UsageError, match=said) as raised:
        find_dataset(str(own_set))
    assert "\n" not in str(raised.value)


def run(folder: Path, source: str, keys: str = "") -> list[dict[Hashable, object]]:
    """Rows of a suite on a data set, beside which the suite lies."""
    suite = folder / "suite.toml"
    suite.write_text(SUITE.format(source=json.dumps(source), keys=keys))
    sysid_bench.run(str(suite), folder / "run", jobs=1)
    return list(sysid_bench.open_run(folder / "run").cells.to_dict("records"))


def test_a_folder_works_where_a_name_does(own_set: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(own_set.parent)
    answer = CliRunner().invoke(main, ["fetch", "./mine"])
    assert answer.exit_code == 0, answer.output
    assert "MIT" in answer.output
    assert sysid_bench.show("./mine")["kind"] == "dataset"
    found = sysid_bench.identify(
        "dataset:./mine", log="dataset:./mine/monday", test="dataset:./mine/tuesday"
    )
    assert found.torque_error is not None
    assert found.torque_error < 0.1
    rows = run(own_set.parent, "file:./mine", 'share = ["100 %", "20 %"]')
    assert [row["status"] for row in rows] == ["ok", "ok"]
    assert {row["robot"] for row in rows} == {"mine"}
    assert {row["held_out"] for row in rows} == {"tuesday (another day)"}
    assert [row["excitation"] for row in rows] == [
        "training motions",
        "training motions, first 20 %",
    ]


@pytest.mark.parametrize("absolute", [False, True])
def test_a_set_beside_the_suite_travels_to_workers(
    own_set: Path, tmp_path: Path, absolute: bool
) -> None:
    source = str(own_set) if absolute else "file:./mine"
    suite = parse_suite(SUITE.format(source=json.dumps(source), keys=""), folder=own_set.parent)
    job = job_of(cells_of_suite(suite).cells, suite, None)
    worker = tmp_path / "worker"
    (worker / "0").mkdir(parents=True)
    own_set.rename(worker / "0" / "mine")
    there = with_folders(job, {str(own_set.parent): str(worker / "0")})
    spec, loaded = load_experiment(there)
    assert loaded.robot.nv == 2
    robot = find_manifest(str(spec.robot), None, Path(there["folder"]))
    assert robot.path.is_relative_to(worker)
    assert spec.log is not None
    for log in (*spec.log["train"], *spec.log["test"]):
        files = log_description(log, Path(there["folder"])).files
        assert files
        assert all(file.is_relative_to(worker) for file in files)


@pytest.mark.parametrize("keys", ["choose = 5", 'choose = "tanh"'])
def test_terms_to_choose_are_a_list(own_set: Path, keys: str) -> None:
    for more in ("", 'choose = ["tanh"]\n'):  # terms that the set itself chooses
        file = own_set / "dataset.toml"
        file.write_text(file.read_text().replace("[robot]", f"{more}[robot]"))
        with pytest.raises(UsageError, match="choose: must be a list; got "):
            mine(own_set, keys)


def test_a_share_is_the_first_part(own_set: Path) -> None:
    robot = load_robot(find_manifest(f"dataset:{own_set}"))
    source = {"use": f"dataset:{own_set}/monday"}
    whole = read_log(log_description(source, Path()), robot).recording
    for share in (0.25, "25 %"):
        part = read_log(log_description({**source, "share": share}, Path()), robot).recording
        assert len(part) == len(whole) // 4
        assert (part.q == whole.q[: len(part)]).all()
    for wrong in ("0 %", "101 %", "25 s", "part"):
        with pytest.raises(UsageError, match="share: "):
            log_description({**source, "share": wrong}, Path())


def mine(own_set: Path, keys: str) -> Suite:
    """A suite on a data set, which is not run."""
    return parse_suite(SUITE.format(source='"file:./mine"', keys=keys), folder=own_set.parent)


def test_a_share_is_a_number_or_in_percent(own_set: Path) -> None:
    plans = [
        cells_of_suite(mine(own_set, f"share = {written}"))
        for written in ("0.1", '"10 %"', '"0.1"')
    ]
    ids = {tuple(cell.id for cell in plan.cells) for plan in plans}
    assert len(ids) == 1
    assert {cell.first_fields["excitation"] for cell in plans[0].cells} == {
        "training motions, first 10 %"
    }


@pytest.mark.parametrize("written", ["0", "1.01", '"101 %"', "-0.1", "true", '"5 s"'])
def test_a_share_beyond_the_whole_is_refused(own_set: Path, written: str) -> None:
    with pytest.raises(UsageError, match="share"):
        mine(own_set, f"share = {written}")


def test_a_set_gives_robot_and_logs(own_set: Path) -> None:
    with pytest.raises(UsageError, match="a data set gives train"):
        run(own_set.parent, str(own_set), 'train = ["x.toml"]')
    with pytest.raises(UsageError, match="no recording with a known payload"):
        run(own_set.parent, str(own_set), 'task = "payload"')


@pytest.mark.long
def test_the_whole_chain_runs_on_a_set_of_ones_own(
    own_set: Path, recordings: dict[str, np.ndarray], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(own_set.parent)
    text = (own_set / "dataset.toml").read_text()
    (own_set / "dataset.toml").write_text(text.replace("another day", "repetition"))
    again = recordings["monday"].copy()
    noise = np.random.default_rng(3).standard_normal((len(again), 2))
    again[:, 2:] += 0.01 * again[:, 2:].std(axis=0) * noise
    np.savetxt(own_set / "tuesday.csv", again, delimiter=",", fmt="%.9g")
    chosen = {"dataset": "./mine"}
    planned = sysid_bench.plan("real", overrides=chosen)
    assert {cell.labels["robot"] for cell in planned.cells} == {"mine"}
    chosen["estimator"] = '[{ use = "wls" }, { use = "entropic" }]'
    done = sysid_bench.run("real", "run", jobs=1, overrides=chosen)
    assert done.exit_code == 0
    monkeypatch.chdir(own_set)  # limits find the set of a run from anywhere
    (limit,) = sysid_bench.limits("../run").robots
    assert limit["robot"] == "mine"
    assert 0 < limit["bound"] < limit["best"] < 0.1
    assert limit["floor"] > limit["bound"]
    assert [Path(file).is_file() for file in sysid_bench.figure("../run", "training-size").files]
    monkeypatch.chdir(own_set.parent)
    table = sysid_bench.twin_table(["./mine", "./mine"], truth=["lmi"])
    assert [row["reason"] for row in table.rows] == [""]
    moved = sysid_bench.transfer(["./mine"], truth=["lmi"], methods=["ols"], levels=["L0"], draws=1)
    assert not moved.reasons
    assert {"recorded", "L0, lmi", "twin, lmi"} <= moved.counts.keys()


@pytest.mark.parametrize(
    ("suite", "source", "said"),
    [
        ("real", "./yours", "not a data set"),
        ("smoke", "./mine", "no .* names a data set"),
    ],
)
def test_a_set_in_place_of_those_of_a_suite_has_to_be(
    suite: str, source: str, said: str, own_set: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(own_set.parent)
    with pytest.raises(UsageError, match=said):
        sysid_bench.plan(suite, overrides={"dataset": source})


def test_a_set_in_the_folder_of_sets_has_its_name(
    own_set: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (own_set.parent / "datasets").mkdir()
    own_set.rename(own_set.parent / "datasets" / "mine")
    monkeypatch.chdir(own_set.parent)
    listed = {entry["name"]: entry["title"] for entry in sysid_bench.list_("datasets")}
    assert listed["mine"] == "Two links on a table"
    assert find_dataset("mine").command_name == "mine"
    assert "unchecked" in sysid_bench.fetch("mine").summary()


@pytest.mark.data
@pytest.mark.long
def test_servos_follow_their_commands_better_than_none(monkeypatch: pytest.MonkeyPatch) -> None:
    if DATA is None:
        pytest.skip("SYSID_BENCH_DATA is not set")
    monkeypatch.setenv("SYSID_BENCH_DATA", DATA)
    fitted = sysid_bench.identify(
        "dataset:so101",
        log="dataset:so101/multisine",
        test="dataset:so101/large-amplitude",
        task="actuators",
    )
    robot = load_robot(find_manifest("dataset:so101"))
    log = read_log(read_description(Path("dataset:so101/large-amplitude")), robot)
    assert log.commands is not None
    lag = np.sqrt(np.mean((log.commands.q - log.commands.q_des) ** 2))
    assert fitted.rollout_error is not None
    assert fitted.rollout_error < lag  # 25.4 against 28.2 mrad
