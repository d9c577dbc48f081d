"""A sealed plant runs where its seed is, and its rows hold the hash alone."""

import hashlib
import json
from pathlib import Path

import pytest

from sysid_bench.errors import UsageError
from sysid_bench.experiments.simulated.composed_plant import composed_plant
from sysid_bench.experiments.spec import SEEDS, plant_seed, seed_of_hash
from sysid_bench.harness.plan import cells_of_suite
from sysid_bench.harness.run import run
from sysid_bench.harness.suite.load_suite import parse_suite

SECRET = "0123456789abcdef" * 4
SEAL = hashlib.sha256(SECRET.encode()).hexdigest()
SUITE = """
schema = 1
name = "tiny"
seed = 3
[defaults]
excitation = { use = "fourier", period = "2 s", cycles = 1 }
held_out = [["ptp"]]
rate = "50 Hz"
plant = ["file:open.toml", "file:sealed.toml"]
[[robot]]
use = "scara"
[[estimator]]
use = "ols"
"""
PLANT = 'schema = 1\neffects = [{ use = "stribeck", share = { from = "5 %", to = "50 %" } }]\n'


@pytest.fixture
def suite(tmp_path: Path) -> Path:
    (tmp_path / "open.toml").write_text(PLANT)
    (tmp_path / "sealed.toml").write_text(f'{PLANT}sealed = "{SEAL}"\n')
    (tmp_path / "tiny.toml").write_text(SUITE)
    (tmp_path / "seeds.txt").write_text(f"{'x' * 40}\n{SECRET}\n")
    return tmp_path / "tiny.toml"


def test_the_seed_of_a_sealed_plant_is_that_of_its_secret(
    suite: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    parsed = parse_suite(suite.read_text(), folder=suite.parent)
    known, sealed = (cell.spec for cell in cells_of_suite(parsed).cells)
    monkeypatch.setenv(SEEDS, str(suite.parent / "seeds.txt"))
    assert seed_of_hash(SEAL) == SECRET
    assert plant_seed(known, "a") != plant_seed(sealed, "a") != plant_seed(sealed, "b")
    assert SECRET not in json.dumps(sealed.to_json())
    assert SEAL in json.dumps(sealed.to_json())


@pytest.mark.parametrize("text", ["", "y" * 40, "short", None])
def test_without_the_seed_the_reason_says_where_it_belongs(
    text: str | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv(SEEDS, raising=False)
    if text is not None:
        (tmp_path / "seeds.txt").write_text(text)
        monkeypatch.setenv(SEEDS, str(tmp_path / "seeds.txt"))
    with pytest.raises(UsageError, match=r"seed|Seed") as error:
        seed_of_hash(SEAL)
    assert "y" * 33 not in str(error.value)


@pytest.mark.parametrize("seal", [3, "abc", SEAL.upper()])
def test_what_is_not_a_hash_is_no_seal(seal: object) -> None:
    with pytest.raises(UsageError, match="SHA-256"):
        composed_plant({"use": "composed", "sealed": seal, "effects": ["stribeck"]})


@pytest.mark.long
def test_rows_of_a_sealed_plant_show_no_size_and_no_secret(
    suite: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv(SEEDS, raising=False)
    out = tmp_path / "out"
    run(str(suite), out, jobs=1)
    monkeypatch.setenv(SEEDS, str(tmp_path / "seeds.txt"))
    before = {row["plant"]: row for row in run(out, jobs=1).folder.rows().rows.values()}
    after = {
        row["plant"]: row for row in run(out, jobs=1, rerun="failed").folder.rows().rows.values()
    }
    assert [before[name]["status"] for name in ("open", "sealed")] == ["ok", "failed"]
    assert SEEDS in before["sealed"]["reason"]
    assert after["sealed"]["status"] == "ok"
    assert "plant_values" in after["open"]
    assert "plant_values" not in after["sealed"]
    assert after["sealed"]["torque_error"] != after["open"]["torque_error"]
    for file in out.rglob("*.*"):
        assert SECRET.encode() not in file.read_bytes()
