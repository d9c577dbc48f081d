"""Laws of planning: what an id and a seed depend on, and that no cell is lost."""

from collections.abc import Callable
from dataclasses import fields as dataclass_fields
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from harness_world import FULL, NAMES, read, small
from hypothesis import given
from hypothesis import strategies as st

from sysid_bench.commands.plan import plan
from sysid_bench.errors import UsageError
from sysid_bench.evaluation.robot_statistic import robots_needed
from sysid_bench.experiments.spec import (
    ExperimentSpec,
    held_out_seed,
    motion_seed,
    noise_seed,
    plant_seed,
    prior_seed,
    seed_of,
    sensor_seed,
)
from sysid_bench.harness.cell import fields
from sysid_bench.harness.plan import Plan, cells_of_suite
from sysid_bench.harness.suite.load_suite import parse_suite, suite_text
from sysid_bench.words import LABELS


def plan_of(text: str) -> Plan:
    return cells_of_suite(read(text), NAMES)


SPEC = plan_of(FULL).cells[-1].spec
CHANGES: dict[str, Any] = {
    "seed": 1,
    "robot": "go2",
    "payload": "sphere-1kg",
    "task": "payload",
    "terms": ("viscous",),
    "plant": {"use": "stribeck"},
    "prior": "truth",
    "excitation": {"use": "fourier", "harmonics": 6},
    "held_out": ({"use": "ptp"},),
    "simulation": {"use": "closed-loop"},
    "rate": 100.0,
    "noise": {"q": 0.1},
    "signals": {"filter": "none", "derivatives": "exact"},
    "repeat": 0,
    "free_base": True,
    "sensor": "wrist",
    "pipeline": {"use": "parallel"},
    "motions": 5,
    "redrawn": ("motions",),
    "candidate": {"step": 1e-3},
    "confidence": 0.9,
    "log": {"train": ["run.toml"]},
    "content": "0123456789ab",
    "model": "0123456789abcdef",
    "data": {"butter 4 20 Hz zero-phase": "0123456789abcdef"},
}
SEEDS: dict[Callable[[ExperimentSpec], int], set[str]] = {
    motion_seed: {"seed", "robot", "content", "excitation", "redrawn"},
    noise_seed: {"seed", "robot", "content", "task", "excitation", "simulation", "rate", "repeat"},
    prior_seed: {"seed", "robot", "content", "payload", "task"},
    sensor_seed: {"seed", "robot", "content", "repeat", "sensor"},
    lambda spec: held_out_seed(spec, 0): {"seed", "robot", "content", "held_out"},
    plant_seed: {"seed", "robot", "content"},
}


def test_every_part_of_a_specification_is_tried() -> None:
    assert set(CHANGES) == {field.name for field in dataclass_fields(ExperimentSpec)}


@pytest.mark.parametrize("part", CHANGES)
def test_an_id_depends_on_every_part(part: str) -> None:
    assert replace(SPEC, **{part: CHANGES[part]}).id != SPEC.id


@pytest.mark.parametrize("part", CHANGES)
@pytest.mark.parametrize(
    "seed", SEEDS, ids=["motion", "noise", "prior", "sensor", "held-out", "plant"]
)
def test_a_seed_depends_on_its_parts_alone(
    seed: Callable[[ExperimentSpec], int], part: str
) -> None:
    changed = seed(replace(SPEC, **{part: CHANGES[part]})) != seed(SPEC)
    assert changed == (part in SEEDS[seed])


def test_seeds_of_one_experiment_differ() -> None:
    same = replace(SPEC, held_out=(SPEC.excitation, SPEC.excitation))
    seeds = [make(same) for make in (motion_seed, noise_seed, prior_seed)]
    seeds += [held_out_seed(same, number) for number in range(2)]
    assert len(set(seeds)) == len(seeds)


@given(st.integers(0), st.lists(st.text() | st.integers() | st.floats(allow_nan=False)))
def test_seeds_have_128_bits_and_are_the_same_twice(root: int, parts: list[Any]) -> None:
    assert 0 <= seed_of(root, *parts) == seed_of(root, *parts) < 2**128


@pytest.mark.parametrize(
    ("one", "other", "is_same"),
    [
        ('rate = "1 kHz"', "rate = 1000", True),
        ('noise = { tau = "0.5 %" }', 'noise = { tau = "0.50 %", q = 0 }', True),
        ('noise = { q = "1 mrad" }', "noise = { q = 1e-3 }", True),
        ('prior = { com = "15 mm" }', 'prior = { com = "1.5 cm", mass = "20 %" }', True),
        ('excitation = "fourier"', 'excitation = { use = "fourier" }', True),
        ('task = "robot"', 'task = ["robot"]', True),
        ("", "motions = 1", True),
        ("", 'pipeline = "plain"', True),  # ids are older than pipelines
        ("", 'pipeline = { use = "plain", standstill = "10 %" }', False),
        ('noise = { tau = "0.5 %" }', 'noise = { tau = "0.005 N m" }', False),
        ("terms = []", "", False),
        ('prior = "none"', 'prior = "truth"', False),
    ],
)
def test_the_same_thing_written_otherwise_is_the_same_cell(
    one: str, other: str, is_same: bool
) -> None:
    a, b = (plan_of(small(f"[defaults]\n{text}")) for text in (one, other))
    ids = [[cell.id for cell in plan.cells] for plan in (a, b)]
    assert ids[0] == ids[1] if is_same else set(ids[0]).isdisjoint(ids[1])


def test_labels_and_limits_change_no_id() -> None:
    plain = plan_of(FULL)
    other = FULL.replace("Geodesic (ours)", "Ours").replace("60 s", "9 s").replace("1e-12", "1e-9")
    assert [cell.id for cell in plan_of(other).cells] == [cell.id for cell in plain.cells]
    named = FULL.replace("{ mass = 1.2", '{ name = "tool", mass = 1.2')
    assert [cell.id for cell in plan_of(named).cells] == [cell.id for cell in plain.cells]
    assert "tool" in {cell.labels["payload"] for cell in plan_of(named).cells}


def test_another_robot_changes_no_other_cell() -> None:
    grown = plan_of(FULL.replace('"ur5", "panda"', '"go2", "ur5", "panda"'))
    assert {cell.id for cell in plan_of(FULL).cells} < {cell.id for cell in grown.cells}


def test_cells_are_experiments_times_estimators() -> None:
    plan = plan_of(FULL)
    # 7 robots with payloads; exact once, noisy three times; two estimators
    assert len(plan.cells) == 7 * (1 + 3) * 2
    assert len(plan.spec_list) * 2 == len(plan.cells) == len({cell.id for cell in plan.cells})
    assert any("repeat 0 stands for all 3" in note for note in plan.notes)
    assert all(cell.seconds > 0 for cell in plan.cells)


def test_closed_loop_repeats_without_noise() -> None:
    text = small('[run]\nrepeats = 4\n[defaults]\nsimulation = ["inverse", "closed-loop"]')
    counts = [cell.labels["simulation"] for cell in plan_of(text).cells]
    assert (counts.count("inverse"), counts.count("closed-loop")) == (1, 4)


def test_excluded_cells_are_counted() -> None:
    text = FULL.replace('"ur5", "panda"', '"go2", "ur5"').replace('use = "ols"', 'use = "didim"')
    plan = plan_of(text)
    assert plan.excluded == {"needs a fixed base": 3 * 4}
    assert len(plan.cells) + 12 == 7 * 4 * 2
    assert not [
        c for c in plan.cells if c.facts["robot.free_base"] and c.estimator["use"] == "didim"
    ]


def test_duplicates_are_run_once_and_reported() -> None:
    plan = plan_of(small('[defaults]\nrate = ["1 kHz", 1000]'))
    assert len(plan.cells) == 1
    assert any("specified twice" in note for note in plan.notes)


def test_a_plan_states_how_many_robots_the_verdicts_of_its_rankings_need() -> None:
    """All verdicts of a suite together; a family has those of its members alone."""
    entry = '[[ranking]]\nname = "{}"\nagainst = "ols"\n{}'
    both = entry.format("r", 'apart = ["noise"]\n') + entry.format(
        "s", 'family = ["Geodesic (ours)"]\n'
    )
    plan = plan_of(FULL + both)
    [note] = [one for one in plan.notes if one.startswith("Rankings")]
    # Two kinds of noise, and the family.
    needed = robots_needed(3)
    assert f"3 verdicts, corrected together; the first needs {needed} robots" in note
    assert needed > 3
    assert "r-exact (3)" in note
    assert "s (3)" in note
    assert not any("verdict" in one for one in plan_of(FULL).notes)
    none = entry.format("t", "select = 'torque_error < 1'\n")  # known of rows alone
    assert any("1 verdict," in note for note in plan_of(FULL + none).notes)


def test_a_plan_names_the_claims_that_cannot_hold() -> None:
    head = (
        '[[claim]]\nname = "{}"\nstatement = "s"\nsource = "t"\nselect = \'estimator == "ols"\'\n'
    )
    share = 'statistic = "share"\nmeets = "rank > 3"\ndirection = "at least"\nthreshold = {}\n'
    never = head.format("never") + share.format("1")
    exact = head.format("algebra") + share.format("1") + "exact = true\n"
    few = head.format("few") + 'statistic = "median"\nmetric = "torque_error"\nthreshold = 1\n'
    [note] = [one for one in plan_of(FULL + never + exact + few).notes if one.startswith("Claims")]
    assert "never (3 robots, needs no number)" in note
    assert "few (3 robots, needs 6)" in note
    assert "algebra" not in note
    repeats = few.replace("few", "own") + 'over = "repeat"\n'
    [note] = [one for one in plan_of(FULL + repeats).notes if one.startswith("Claims")]
    assert "own (3 repeats, needs 6)" in note
    with pytest.raises(UsageError, match="share of 1"):
        plan_of(FULL + few + "exact = true\n")


SWEEPS = small(
    '[defaults]\nexcitation = ["fourier", { use = "fourier", period = 3 }]\n'
    'prior = ["truth", { mass = "1 %" }, { mass = "1 %", com = 3 }]\nterms = [[], ["viscous"]]\n'
    'noise = [{}, { q = 1e-3 }, { q = 1e-4 }]\nrate = [100, 200.5]\n'
    'held_out = ["ptp", { use = "ptp", stops = 3 }]',
    estimators='[[estimator]]\nuse = "ols"\nlabel = "A"\n[[estimator]]\nuse = "wls"\nlabel = "A"\n'
    '[[estimator]]\nuse = "wls"\ncut = 2\n',
)  # fmt: skip


@pytest.mark.parametrize("text", [FULL, SWEEPS], ids=["full", "sweeps"])
def test_labels_distinguish_all_values(text: str) -> None:
    plan = plan_of(text)
    heads = [(*(cell.labels[axis] for axis in LABELS), cell.spec.repeat) for cell in plan.cells]
    assert len(set(heads)) == len(heads)
    assert all(label and isinstance(label, str) for head in heads for label in head[:-1])


def test_exact_data_are_called_exact() -> None:
    labels = {cell.labels["noise"]: cell.spec.noise for cell in plan_of(FULL).cells}
    assert labels == {"exact": {}, "q 1e-4 rad, tau 0.5 %": {"q": 1e-4, "tau_relative": 0.005}}


def test_a_plan_reads_back_as_the_same_cells() -> None:
    for text in (FULL, SWEEPS):
        plan = plan_of(text)
        again = Plan.from_json_lines(line.encode() for line in plan.to_json_lines())
        assert again.cells == plan.cells
        assert [fields(cell) for cell in again.cells] == [fields(cell) for cell in plan.cells]
        assert len(list(plan.to_json_lines())) == len(plan.cells)


def test_a_plan_that_was_changed_by_hand_is_refused() -> None:
    text = "".join(plan_of(FULL).to_json_lines())
    with pytest.raises(UsageError, match=r"plan\.jsonl:1: the cell"):
        Plan.from_json_lines(
            text.replace('"rate": 200.0', '"rate": 300.0', 1).encode().splitlines()
        )
    with pytest.raises(UsageError, match=r"plan\.jsonl:2"):
        Plan.from_json_lines([text.splitlines()[0].encode(), b"{}"])


@pytest.mark.parametrize(
    ("text", "count"),
    [
        ('robot == "panda" and noise.tau < 0.01', 3 * 3 * 2),
        ('noise == "exact"', 7 * 2),
        ('estimator == "mylab.methods:Geodesic" and repeat == 0', 7 * 2),
        ('estimator == "Geodesic (ours)"', 7 * 4),
        ('robot == "file:models/my_arm.urdf"', 8),
        ('robot == "my_arm" and excitation.period == "5 s"', 8),
        ('rate == "0.2 kHz" and prior.com < "2 cm"', 56),
        ("payload.mass > 1 and terms == 'none'", 2 * 4 * 2),
        ("robot.free_base", 0),
    ],
)
def test_expressions_select_cells(text: str, count: int) -> None:
    assert len(plan_of(FULL).select(text)) == count
    assert len(plan_of(FULL).select(f"not ({text})")) == 56 - count


BASED = (
    'schema = 1\nname = "based"\n[[robot]]\nuse = ["file:a/my_arm.urdf", "file:b/my_arm.urdf"]\n'
    '[[robot]]\nuse = ["ur5", "file:a/leg.urdf"]\nfree_base = false\n'
    '[[estimator]]\nuse = "ols"\n'
)


@pytest.mark.parametrize(
    ("robot", "count"),
    [
        ("ur5", 1), ("ur5 (fixed base)", 1), ("leg", 1), ("leg (fixed base)", 1),
        ("file:a/leg.urdf", 1), ("my_arm", 2), ("file:b/my_arm.urdf", 1), ("arm", 0),
    ],
)  # fmt: skip
def test_a_robot_goes_by_its_label_its_source_and_its_file(robot: str, count: int) -> None:
    assert len(plan_of(BASED).select(f'robot == "{robot}"')) == count


def test_texts_that_no_cell_has_are_reported_with_their_nearest() -> None:
    plan = plan_of(BASED)
    (reported,) = plan.unknown_values('robot in ["ur6", "leg"] and task == "robot" and repeat == 0')
    assert "robot == 'ur6'" in reported
    assert "ur5" in reported
    (reported,) = plan.unknown_values('not "zzzz" == estimator')
    assert "estimator == 'zzzz'; there is ols." in reported
    assert plan.unknown_values('rate == "1 kHz" or robot != "nothing"') == []


def test_an_unknown_field_selects_nothing_and_says_so() -> None:
    with pytest.raises(UsageError, match=r"noise\.tau"):
        plan_of(FULL).select("noise.tao < 1")


def test_a_ranking_against_a_method_that_is_not_there_is_found_before_the_run() -> None:
    text = small() + '\n[[ranking]]\nname = "order"\nagainst = "{}"\n'
    methods = {cell.labels["estimator"] for cell in plan_of(small()).cells}
    assert plan_of(text.format(next(iter(methods)))).cells
    with pytest.raises(UsageError, match="order"):
        plan_of(text.format("nobody"))


@pytest.mark.parametrize("label", ["floor", "null model", "Null  Model"])
def test_an_estimator_has_not_the_label_of_a_baseline(label: str) -> None:
    """Tables and rankings would print it as one."""
    text = f'{small()}\n[[estimator]]\nuse = "wls"\nlabel = "{{}}"\n'
    assert plan_of(text.format(f"{label} 2")).cells
    with pytest.raises(UsageError, match="label of a baseline"):
        plan_of(text.format(label))


def test_methods_that_depend_on_link_frames_have_no_verdict_in_a_plan() -> None:
    """As in the tables of the run; a reference keeps its place."""
    names = replace(NAMES, plugin=lambda kind, spec: None)
    methods = "".join(f'[[estimator]]\nuse = "{name}"\n' for name in ("lmi", "tls", "essential"))
    entry = f'{methods}[[ranking]]\nname = "r"\nagainst = "{{}}"\n{{}}\n'

    def notes(against: str, family: str = "") -> str:
        suite = parse_suite(small() + entry.format(against, family), names=names)
        return "\n".join(cells_of_suite(suite, names).notes)

    count = len({cell.labels["estimator"] for cell in plan_of(small()).cells})
    for against in ("lmi", "tls"):
        verdicts = count + (against != "lmi")
        assert f"{verdicts} verdict" in notes(against)
    assert "1 verdict," in notes("ols", 'family = ["tls", "lmi"]')
    with pytest.raises(UsageError, match="'r' has no method with a verdict: tls, essential"):
        notes("lmi", 'family = ["tls", "essential"]')


def test_torques_are_shown_along_a_log() -> None:
    with pytest.raises(UsageError, match=r"no \[\[log\]\]"):
        read(small() + '\n[[paper]]\nname = "torques"\nshow = "torques"\n')


# --- Pipelines ----------------------------------------------------------------------------------


NOISY = 'noise = { q = "1e-5 rad" }'
LOOP = 'simulation = "closed-loop"'
WRITTEN = 'signals = { filter = "average 5", derivatives = "from q" }'


@pytest.mark.parametrize(
    ("keys", "expected"),
    [
        ("", None),  # exact playback
        ('noise = { tau = "1 %", force = "1 N" }', None),  # positions are exact
        (NOISY, {"use": "parallel"}),
        ('noise = { quantum = "1e-5 rad" }', {"use": "parallel"}),
        (LOOP, {"use": "parallel"}),
        ('signals = { runs = "AB" }\n' + NOISY, {"use": "parallel"}),
        ('plant = "L0"', {"use": "parallel"}),
        ('plant = "L2"', {"use": "parallel"}),
        (
            'plant = { use = "composed", sensors = [{ use = "delay", tau = "1 ms" }] }',
            {"use": "parallel"},
        ),
        (f"{WRITTEN}\n{NOISY}\n{LOOP}", None),
        ('signals = { derivatives = "exact" }\n' + LOOP, None),
        (f'pipeline = "plain"\n{NOISY}', None),
        (f'pipeline = "raw"\n{WRITTEN}', {"use": "raw"}),
    ],
)
def test_specifications_state_the_pipeline_that_a_suite_leaves_open(
    keys: str, expected: dict[str, Any] | None
) -> None:
    """Positions that are exact need no filter; who writes one has it; all else is `parallel`."""
    suite = parse_suite(small(f"[defaults]\n{keys}"))
    cells = cells_of_suite(suite).cells
    assert [cell.spec.pipeline for cell in cells] == [expected] * len(cells)
    assert {cell.labels["pipeline"] for cell in cells} == {(expected or {"use": "plain"})["use"]}
    again = parse_suite(suite_text(suite))  # a frozen suite means the same
    assert [cell.id for cell in cells_of_suite(again).cells] == [cell.id for cell in cells]


def test_only_plain_reads_the_filters_of_signals() -> None:
    """A pipeline of its own settings is planned once, however many filters `plain` tries."""
    sweep = """
    [defaults]
    pipeline = ["plain", { use = "parallel", cutoff = "6 Hz" }]
    signals = [{ filter = "none" }, { filter = "average 5" }]
    """
    cells = plan_of(small(sweep)).cells
    counts = dict.fromkeys(("plain", "parallel"), 0)
    for cell in cells:
        counts[cell.labels["pipeline"].split()[0]] += 1
    assert counts["plain"] == 2 * counts["parallel"] > 0
    assert {fields(cell).get("pipeline.cutoff") for cell in cells} == {None, "6 Hz"}


# --- Several motions ----------------------------------------------------------------------------


def test_motions_are_a_factor() -> None:
    swept = plan_of(small("[defaults]\nmotions = [1, 5]\nredrawn = ['plant', 'motions']")).cells
    assert len(swept) == 2 * len(plan_of(small()).cells)
    assert {cell.labels["motions"] for cell in swept} == {"1", "5"}
    assert {fields(cell)["motions"] for cell in swept} == {1, 5}
    assert {cell.spec.redrawn for cell in swept} == {("motions", "plant")}


def test_what_is_redrawn_is_repeated_without_noise() -> None:
    suite = "[run]\nrepeats = 3\n[defaults]\n"
    assert len(plan_of(small(suite)).cells) * 3 == len(
        plan_of(small(suite + "redrawn = 'motions'")).cells
    )


@pytest.mark.parametrize("wrong", ["motions = 0", "motions = 1.5", "redrawn = 'motion'"])
def test_impossible_motions_are_refused(wrong: str) -> None:
    with pytest.raises(UsageError, match=wrong.split()[0]):
        plan_of(small(f"[defaults]\n{wrong}"))


@pytest.mark.parametrize("text", ["hello", "<svg/>"])
def test_a_robot_file_that_is_no_model_is_refused(text: str, tmp_path: Path) -> None:
    (tmp_path / "arm.urdf").write_text(text)
    suite = tmp_path / "bad.toml"
    suite.write_text(
        'schema = 1\nname = "bad"\n[[robot]]\nuse = "file:arm.urdf"\n[[estimator]]\nuse = "wls"\n'
    )
    with pytest.raises(UsageError, match="neither URDF nor MJCF"):
        plan(suite)
