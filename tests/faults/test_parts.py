"""Law: a faulty excitation, effect or metric is the row of its own cells, wherever it stands."""

from pathlib import Path
from typing import Any

import pytest

from sysid_bench.harness.run import run
from sysid_bench.harness.suite.load_suite import parse_suite
from sysid_bench.vocabulary import MACHINE_FIELDS

HERE = Path(__file__).parent
FOURIER = '{ use = "fourier", harmonics = 3, period = "2 s" }'
STATUS = {"crash": "crash", "kill": "lost", "raise": "failed", "hang": "timeout"}


def part(name: str, act: str) -> str:
    return f'{{ use = "file:{HERE}/faulty_parts.py:{name}", act = "{act}" }}'


def rows(out: Path, lists: dict[str, list[str]], more: str = "") -> dict[str, dict[str, Any]]:
    """Rows by their label of the first of these lists."""
    text = 'schema = 1\nname = "parts"\n[run]\ntimeout = "20 s"\n[defaults]\n'
    for key, values in {"excitation": [FOURIER], **lists}.items():
        text += f"{key} = [{', '.join(values)}]\n"
    text += f'[[robot]]\nuse = "scara"\n[[estimator]]\nuse = "ols"\n{more}'
    result = run(parse_suite(text, folder=HERE), out, jobs=2)
    return {
        row["id"]: {key: value for key, value in row.items() if key not in MACHINE_FIELDS}
        for row in result.folder.rows().rows.values()
    }


@pytest.mark.parametrize(
    ("key", "sound", "name"),
    [
        ("excitation", (FOURIER, '"ptp"'), "Excitation"),
        ("plant", ('"matched"', '"stribeck"'), "Effect"),
    ],
)
def test_a_part_of_an_experiment(
    tmp_path: Path, key: str, sound: tuple[str, str], name: str
) -> None:
    """The first, two middle and the last experiments of a suite have each another fault."""
    undisturbed = rows(tmp_path / "sound", {key: list(sound)})
    assert [row["status"] for row in undisturbed.values()] == ["ok", "ok"]
    crash, kill, throw, hang = (part(name, act) for act in STATUS)
    found = rows(tmp_path / "run", {key: [crash, sound[0], kill, throw, sound[1], hang]})
    assert {cell: found.pop(cell) for cell in undisturbed} == undisturbed
    assert sorted(row["status"] for row in found.values()) == sorted(STATUS.values())
    assert all(row["reason"] for row in found.values())


def test_a_metric(tmp_path: Path) -> None:
    """It is computed in every cell: each has its own row."""
    metric = f'[[metric]]\nuse = "file:{HERE}/faulty_parts.py:metric"\nact = "kill"\n'
    found = rows(tmp_path, {"excitation": [FOURIER, '"ptp"']}, metric)
    assert [row["status"] for row in found.values()] == ["lost"] * 2
