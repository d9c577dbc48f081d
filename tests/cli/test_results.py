"""Results of commands: frozen records that also read as mappings, and print in notebooks."""

import json
from dataclasses import FrozenInstanceError, dataclass, field
from pathlib import Path

import pytest

import sysid_bench
from sysid_bench.cli import main
from sysid_bench.errors import UsageError
from sysid_bench.verbs.result import OMIT_NONE, Result


@dataclass(frozen=True, eq=False, repr=False)
class Sample(Result):
    """A result with one field of each kind."""

    name: str
    gap: float
    rows: list[str]
    note: str | None = field(default=None, metadata=OMIT_NONE)


SAMPLE = Sample("a<b", float("inf"), ["x", "y", "z", "w"])


def test_a_result_reads_as_a_mapping() -> None:
    assert SAMPLE["name"] == SAMPLE.name
    assert list(SAMPLE) == ["name", "gap", "rows"]
    assert dict(SAMPLE) == SAMPLE
    assert {**SAMPLE}["rows"] == SAMPLE.rows
    assert SAMPLE.get("note") is None
    with pytest.raises(KeyError):
        SAMPLE["note"]
    assert Sample("a", 1.0, [], "n")["note"] == "n"


def test_json_has_numbers_or_null() -> None:
    assert json.loads(json.dumps(SAMPLE.to_dict())) == {
        "name": "a<b",
        "gap": None,
        "rows": ["x", "y", "z", "w"],
    }


def test_a_result_is_frozen() -> None:
    with pytest.raises(FrozenInstanceError):
        SAMPLE.name = "c"  # type: ignore[misc]


def test_a_result_is_readable() -> None:
    assert repr(SAMPLE) == "Sample(name='a<b', gap=inf, rows=<4 entries>)"
    assert "a&lt;b" in SAMPLE._repr_html_()
    assert "gap" in SAMPLE.summary()


def test_a_verdict_is_a_result() -> None:
    (verdict,) = sysid_bench.crosscheck("scara", samples=3)
    assert verdict.ok is verdict["ok"] is True
    assert verdict.to_dict() == json.loads(json.dumps(dict(verdict)))
    assert verdict.summary().startswith("scara: agrees")
    assert "joints=<" in repr(verdict)
    assert isinstance(verdict, sysid_bench.CrosscheckResult)


def test_a_file_that_cannot_be_used_is_a_result(tmp_path: Path) -> None:
    file = tmp_path / "broken.urdf"
    file.write_text("<robot name='x'><link name='a'/>")
    (verdict,) = sysid_bench.crosscheck(file)
    assert not verdict.ok
    assert verdict.nv is None
    assert verdict.summary() == f"broken: {verdict.reason}"


def test_a_plan_counts_its_cells() -> None:
    plan = sysid_bench.plan("smoke", 'robot == "ur5"')
    assert plan["cells"] == len(plan.cells) > 0
    assert plan["experiments"] == len(plan.experiments)
    assert plan.summary().startswith(f"{len(plan.cells)} cells in ")


def test_one_source_of_data_is_given() -> None:
    with pytest.raises(UsageError, match="--simulate"):
        sysid_bench.identify("ur5", log="run.toml", simulate=True)


def test_every_command_is_a_function_of_the_package() -> None:
    functions = {
        "list": "list_", "check-plugin": "check_plugin", "init": "init_robot",
    }  # fmt: skip
    names = {functions.get(name, name) for name in main.commands}
    assert names <= set(dir(sysid_bench))
    assert set(dir(sysid_bench)) - {"__version__"} == set(sysid_bench.__all__)
    for name in sysid_bench.__all__:
        assert getattr(sysid_bench, name).__doc__, name
