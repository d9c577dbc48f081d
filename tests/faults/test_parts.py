"""Law: a faulty part of an experiment, a plug-in of any kind, is the row of its own cells, wherever
it stands."""

from pathlib import Path
from typing import Any

import pytest

from sysid_bench.errors import UsageError
from sysid_bench.harness.suite.load_suite import parse_suite
from sysid_bench.verbs.runs.run import run
from sysid_bench.words import MACHINE_FIELDS
from tests.robots import named_robot
from tests.signals.logs import recorded, write

HERE = Path(__file__).parent
FAULTY = f"file:{HERE}/faulty_parts.py"
FOURIER = '{ use = "fourier", harmonics = 3, period = "2 s" }'
STATUS = {"crash": "crash", "kill": "lost", "raise": "failed", "hang": "timeout"}
Rows = dict[str, dict[str, Any]]


def part(name: str, act: str) -> str:
    return f'{{ use = "{FAULTY}:{name}", act = "{act}" }}'


def composed(group: str, name: str, act: str) -> str:
    """A plant with one error."""
    return f'{{ use = "composed", name = "{act} {name}", {group} = [{part(name, act)}] }}'


def rows(out: Path, text: str, folder: Path = HERE) -> Rows:
    """Rows of a suite with these parts and one method."""
    head = 'schema = 1\nname = "parts"\n[run]\ntimeout = "20 s"\n'
    suite = parse_suite(f'{head}{text}[[estimator]]\nuse = "ols"\n', folder=folder)
    return {
        row["id"]: {key: value for key, value in row.items() if key not in MACHINE_FIELDS}
        for row in run(suite, out, jobs=2).folder.rows().rows.values()
    }


def simulated(lists: dict[str, list[str]]) -> str:
    """A robot, with lists of the values of some keys."""
    text = "[defaults]\n"
    for key, values in {"excitation": [FOURIER], **lists}.items():
        text += f"{key} = [{', '.join(values)}]\n"
    return f'{text}[[robot]]\nuse = "scara"\n'


def check(found: Rows, undisturbed: Rows) -> None:
    """Each fault is one row, and the rows of sound parts are those of a suite without faults."""
    assert [row["status"] for row in undisturbed.values()] == ["ok", "ok"]
    assert {cell: found.pop(cell) for cell in undisturbed} == undisturbed
    assert sorted(row["status"] for row in found.values()) == sorted(STATUS.values())
    assert all(row["reason"] for row in found.values())


@pytest.mark.parametrize(
    ("key", "sound", "faulty"),
    [
        ("excitation", (FOURIER, '"ptp"'), [part("Excitation", act) for act in STATUS]),
        ("plant", ('"matched"', '"stribeck"'), [part("Effect", act) for act in STATUS]),
        (
            "plant",
            (composed("errors", "ModelError", ""), composed("sensors", "SensorError", "")),
            [
                composed(*(("errors", "ModelError"), ("sensors", "SensorError"))[i % 2], act)
                for i, act in enumerate(STATUS)
            ],
        ),
        (
            "pipeline",
            ('"raw"', f'"{FAULTY}:SoundPipeline"'),
            [part("Pipeline", act) for act in STATUS],
        ),
        (
            "simulation",
            ('"inverse"', f'"{FAULTY}:SoundSimulation"'),
            [part("Simulation", act) for act in STATUS],
        ),
        (
            "task",
            ('"robot"', f'"{FAULTY}:SoundTask"'),
            [f'"{FAULTY}:{act.title()}Task"' for act in STATUS],
        ),
    ],
)
def test_a_part_of_an_experiment(
    tmp_path: Path, key: str, sound: tuple[str, str], faulty: list[str]
) -> None:
    """The first, two middle and the last experiments of a suite have each another fault."""
    undisturbed = rows(tmp_path / "sound", simulated({key: list(sound)}))
    crash, kill, throw, hang = faulty
    parts = [crash, sound[0], kill, throw, sound[1], hang]
    check(rows(tmp_path / "run", simulated({key: parts})), undisturbed)


def test_a_log_reader(tmp_path: Path) -> None:
    """Faulty readers of the first, two middle and the last recordings of a suite."""
    log = recorded(named_robot("scara"), period=2.0)
    sound = {"csv": None, "own": {"use": f"{FAULTY}:Reader", "act": ""}}
    readers = {act: {"use": f"{FAULTY}:Reader", "act": act} for act in STATUS} | sound
    entry = {}
    for name, reader in readers.items():
        write(tmp_path, log, name=name, reader=reader)
        files = f'train = ["{name}.toml"]\ntest = ["{name}.toml"]\n'
        entry[name] = f'[[log]]\nname = "{name}"\nrobot = "scara"\n{files}'
    undisturbed = rows(tmp_path / "sound", "".join(entry[name] for name in sound), tmp_path)
    order = ("crash", "csv", "kill", "raise", "own", "hang")
    check(rows(tmp_path / "run", "".join(entry[name] for name in order), tmp_path), undisturbed)


def test_a_metric(tmp_path: Path) -> None:
    """It is computed in every cell: each has its own row."""
    metric = f'[[metric]]\nuse = "{FAULTY}:metric"\nact = "kill"\n'
    found = rows(tmp_path, simulated({"excitation": [FOURIER, '"ptp"']}) + metric)
    assert [row["status"] for row in found.values()] == ["lost"] * 2


@pytest.mark.parametrize("name", ["status", "id", "joints", "robot", "nv", "row_sha256", "rank"])
def test_a_metric_with_the_name_of_another_field(tmp_path: Path, name: str) -> None:
    """It would take the place of the status, or of a row as a whole."""
    file = tmp_path / "metric.py"
    file.write_text(
        "from sysid_bench.types import Metric\n"
        f"own = Metric({name!r}, 'Own', compute=lambda cell: 1.0)\n"
    )
    with pytest.raises(UsageError, match=f"{name!r} is a field of rows already"):
        rows(tmp_path / "run", simulated({}) + f'[[metric]]\nuse = "file:{file}:own"\n')
