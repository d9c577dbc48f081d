"""`cells` lists what a run planned: selected, sorted, with reasons and commands."""

import json
from pathlib import Path

import pytest

from .conftest import Run, one_sentence, small_suite


def test_cells_are_listed_as_they_were_asked_for(cli: Run, tmp_path: Path) -> None:
    (tmp_path / "s.toml").write_text(small_suite())
    assert cli("run", "s.toml", "-o", "out", "-j", "1", "--limit", "4").returncode == 0
    planned = [json.loads(line)["id"] for line in _lines(tmp_path / "out/plan.jsonl")]

    whole = json.loads(cli("cells", "out", "--json").stdout)
    assert [cell["id"] for cell in whole["cells"]] == planned
    assert whole["planned"] == len(planned)
    for cell in whole["cells"][::7]:
        alone = json.loads(cli("cell", "out", cell["id"], "--json").stdout)
        assert (cell["status"], cell["command"]) == (alone["status"], alone["command"])

    done = json.loads(cli("cells", "out", "--select", 'status == "ok"', "--json").stdout)["cells"]
    assert len(done) == 4
    assert all(cell["torque_error"] is not None for cell in done)
    for sort, is_falling in (("torque_error", False), ("-torque_error", True)):
        listed = json.loads(cli("cells", "out", "--sort", sort, "--json").stdout)["cells"]
        errors = [cell["torque_error"] for cell in listed]
        assert errors[:4] == sorted(errors[:4], reverse=is_falling)
        assert set(errors[4:]) == {None}  # cells without a value come last

    text = cli("cells", "out", "--select", 'status == "open"', "--limit", "1", "--show", "rank")
    assert "| rank |" in text.stdout.splitlines()[0]
    assert f"{len(planned) - 4} of {len(planned)} cells" in text.stdout
    assert "open: has not run yet" in cli("cells", "out", "--long").stdout
    assert f"--select 'id == \"{planned[0]}\"' --rerun all" in cli("cells", "out", "--long").stdout


@pytest.mark.long
def test_cells_are_repeated_with_other_last_bits(cli: Run, tmp_path: Path) -> None:
    (tmp_path / "s.toml").write_text(small_suite())
    assert cli("run", "s.toml", "-o", "out", "-j", "1", "--limit", "4").returncode == 0
    done = cli("cells", "out", "--select", 'status == "ok"', "--sample", "2", "--last-bits", "1")
    assert done.stdout.splitlines()[0].endswith("| last_bits |")
    assert done.stdout.count("| same |") == 2
    assert "; 0 give another answer" in done.stdout


def _lines(file: Path) -> list[str]:
    return file.read_text(encoding="utf-8").splitlines()


@pytest.mark.parametrize("option", ["--sort", "--show"])
def test_what_is_not_there_is_named(cli: Run, tmp_path: Path, option: str) -> None:
    (tmp_path / "s.toml").write_text(small_suite())
    cli("run", "s.toml", "-o", "out", "-j", "1", "--limit", "1")
    assert "'torque_error'" in one_sentence(cli("cells", "out", option, "torque_eror"))
    assert cli("cells", "out", "--select", 'robot == "nobody"').returncode == 4
