"""Results of commands: frozen records that also read as mappings, and print in notebooks."""

import json
from dataclasses import FrozenInstanceError, dataclass, field
from pathlib import Path

import pytest

import sysid_bench
from sysid_bench.commands.result import OMIT_NONE, Result, interval_text, short_names
from sysid_bench.commands.table import VERBS
from sysid_bench.errors import UsageError


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


def test_an_unknown_key_names_the_nearest() -> None:
    with pytest.raises(KeyError, match="nmae; did you mean 'name'"):
        SAMPLE["nmae"]
    with pytest.raises(KeyError, match=r"^'xyzzy'$"):
        SAMPLE["xyzzy"]
    assert "nmae" not in SAMPLE


def test_json_has_numbers_or_null() -> None:
    assert json.loads(json.dumps(SAMPLE.to_dict())) == {
        "name": "a<b",
        "gap": None,
        "rows": ["x", "y", "z", "w"],
    }


@pytest.mark.parametrize("middle", [0.0, 2.0, -3e-7, 1234.5])
@pytest.mark.parametrize("half", [0.0, 1e-15, 3e-7, 0.4, 1e5])
def test_the_ends_of_an_interval_never_print_alike(middle: float, half: float) -> None:
    text = interval_text(middle - half, middle + half)
    if text.startswith("["):
        low, high = map(float, text.strip("[]").split(", "))
        assert low < high
        assert [low, high] == pytest.approx([middle - half, middle + half], rel=1e-3)
    else:
        found, width = map(float, text.split(" ± "))
        assert found == pytest.approx(middle, rel=1e-3, abs=1e-16)
        assert width == pytest.approx(half, rel=0.5, abs=2e-16 * abs(middle))


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


@pytest.mark.parametrize("seed", ["x", 1.5, -1, None])
def test_a_seed_is_an_integer(seed: object) -> None:
    with pytest.raises(UsageError, match="seed must be an integer of 0 or more"):
        sysid_bench.identify("scara", seed=seed)  # type: ignore[arg-type]
    with pytest.raises(UsageError, match="seed must be an integer of 0 or more"):
        sysid_bench.excite(sysid_bench.ExciteRequest("scara", seed=seed))  # type: ignore[arg-type]


def test_a_list_is_not_a_robot() -> None:
    with pytest.raises(UsageError, match=r"one by one, as crosscheck\('ur5', 'panda'\)"):
        sysid_bench.crosscheck(["ur5"])  # type: ignore[arg-type]


def test_options_of_the_other_source_are_named() -> None:
    with pytest.raises(UsageError, match=r"^--noise: for simulated data only"):
        sysid_bench.identify("ur5", log="run.toml", noise={"q": "1e-4 rad"}, sensor="wrist")
    with pytest.raises(UsageError, match=r"^--test, --position-given: for recordings only"):
        sysid_bench.identify("ur5", test="run.toml", position_given=True)


def test_a_summary_has_base_parameters_and_one_line_for_bodies_without_values() -> None:
    result = sysid_bench.identify("ur5", noise={"tau": "0.5 %"})
    lines = result.summary().splitlines()
    assert (
        lines.count(
            "  nothing is identifiable on its own: "
            "base_link, shoulder_link, wrist_3_link, ee_link, tool0, base"
        )
        == 1
    )
    start = lines.index("  base parameters, most significant first:")
    assert lines[start + 9] == f"    ... {len(result.base) - 8 - 3} more (--json)"
    sizes = {e["expression"]: abs(e["value"]) / e["std"] for e in result.base}
    singles = [line.split()[-1] for line in lines[start + 1 : start + 9] if line.count(" + ") == 0]
    assert singles
    assert sorted(singles, key=sizes.__getitem__, reverse=True) == singles
    ranked = sorted(sizes, key=sizes.__getitem__, reverse=True)
    assert set(singles) <= set(ranked[:8])
    weakest = [line.split()[-1] for line in lines[start + 10 : start + 13] if " + " not in line]
    assert set(weakest) <= set(ranked[-3:])


@pytest.mark.parametrize(("robot", "task"), [("scara", "robot"), ("ur5", "link")])
def test_the_first_line_says_what_is_known_and_how_well(robot: str, task: str) -> None:
    result = sysid_bench.identify(robot, task=task, noise={"tau": "1 %"})
    first = result.summary().splitlines()[0]
    known = sum(entry["std"] < 0.1 * abs(entry["value"]) for entry in result.base)
    assert first.startswith(f"{robot}: ")
    assert f"{known} of {result.rank} base parameters are known within 10 %. Torques of" in first
    assert f"err by {100 * result.torque_error:.3g} %" in first
    assert f"{100 * result.torque_error_null:.3g} %, the mean torque" in first
    if task == "link":
        assert "mass of wrist_3_link 0.1" in first


def test_words_that_all_names_share_are_left_out() -> None:
    def shown(*names: str) -> tuple[list[str], str]:
        short, left_out = short_names(names)
        return list(short.values()), left_out

    assert shown("panda_joint1", "panda_joint2") == (["joint1", "joint2"], " (panda_*)")
    assert shown("hip_joint", "fl_knee_joint") == (["hip", "fl_knee"], " (*_joint)")
    assert shown("arm_1_joint", "arm_2_joint") == (["1", "2"], " (arm_*_joint)")
    for same in (("joint", "joint_2"), ("joint1", "joint2"), ("a_joint",), ("a", "b")):
        assert shown(*same) == (list(same), "")


def test_one_source_of_data_is_given() -> None:
    with pytest.raises(UsageError, match="--simulate"):
        sysid_bench.identify("ur5", log="run.toml", simulate=True)


def test_every_command_is_a_function_of_the_package() -> None:
    functions = {"list": "list_", "baseline": "baseline_save", "help": "help_"}
    verbs = [name for name, verb in VERBS.items() if verb.target and name != "completion"]
    names = {functions.get(name, name.replace(" ", "_").replace("-", "_")) for name in verbs}
    assert names <= set(dir(sysid_bench))
    assert set(dir(sysid_bench)) - {"__version__"} == set(sysid_bench.__all__)
    for name in sysid_bench.__all__:
        assert getattr(sysid_bench, name).__doc__, name


@pytest.mark.parametrize(("robot", "task"), [("ur5", "payload"), ("scara", "robot")])
def test_an_exact_answer_has_no_deviations_and_one_from_noise_has(robot: str, task: str) -> None:
    """Without noise the estimate is the truth but for rounding, which is not printed."""
    exact = sysid_bench.identify(robot, task=task, payload="sphere-1kg")
    assert 0 < exact["exact"] < 1e-9
    text = exact.summary()
    assert "±" not in text
    values = text.partition("\n")[2].partition("\n")[2]
    assert "base parameters, largest first" in values
    assert "e-1" not in values
    assert f"base parameters are exact to {exact['exact']:g} of the largest. Torques of" in text
    noisy = sysid_bench.identify(robot, task=task, payload="sphere-1kg", noise={"tau": "0.5 %"})
    assert "exact" not in noisy
    assert "±" in noisy.summary()
    assert "exact to" not in noisy.summary()
