"""`cells` lists what a run planned: selected, sorted, with reasons and commands."""

import json
from pathlib import Path

import pytest

from .conftest import Run, keep_rows


def test_cells_are_listed_as_they_were_asked_for(cli: Run, copied: Path) -> None:
    lines = (copied / "run/plan.jsonl").read_text(encoding="utf-8").splitlines()
    planned = [json.loads(line)["id"] for line in lines]
    keep_rows(copied / "run", lambda row: row["id"] in planned[:4])

    whole = json.loads(cli("cells", "run", "--json").stdout)
    assert [cell["id"] for cell in whole["cells"]] == planned
    assert whole["planned"] == len(planned)
    for cell in whole["cells"][::7]:
        alone = json.loads(cli("cell", "run", cell["id"], "--json").stdout)
        assert (cell["status"], cell["command"]) == (alone["status"], alone["command"])

    done = json.loads(cli("cells", "run", "--select", 'status == "ok"', "--json").stdout)["cells"]
    assert len(done) == 4
    assert all(cell["torque_error"] is not None for cell in done)
    for sort, is_falling in (("torque_error", False), ("-torque_error", True)):
        listed = json.loads(cli("cells", "run", "--sort", sort, "--json").stdout)["cells"]
        errors = [cell["torque_error"] for cell in listed]
        assert errors[:4] == sorted(errors[:4], reverse=is_falling)
        assert set(errors[4:]) == {None}  # cells without a value come last

    text = cli("cells", "run", "--select", 'status == "open"', "--limit", "1", "--show", "rank")
    assert "| rank |" in text.stdout.splitlines()[0]
    assert f"{len(planned) - 4} of {len(planned)} cells" in text.stdout
    assert "open: has not run yet" in cli("cells", "run", "--long").stdout
    assert f"--select 'id == \"{planned[0]}\"' --rerun all" in cli("cells", "run", "--long").stdout


@pytest.mark.long
@pytest.mark.usefixtures("copied")
def test_cells_are_repeated_with_other_last_bits(cli: Run) -> None:
    done = cli("cells", "run", "--select", 'status == "ok"', "--sample", "2", "--last-bits", "1")
    assert done.stdout.splitlines()[0].endswith("| last_bits |")
    assert done.stdout.count("| same |") == 2
    assert "; 0 give another answer" in done.stdout


@pytest.mark.usefixtures("copied")
def test_nothing_selected_has_a_code_of_its_own(cli: Run) -> None:
    assert cli("cells", "run", "--select", 'robot == "nobody"').returncode == 4
    assert cli("run", "s.toml", "-o", "out", "--select", 'robot == "panda"').returncode == 4
