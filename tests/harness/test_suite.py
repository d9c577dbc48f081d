"""Laws of the suite file: nothing is lost between text and suite, and no mistake goes untold."""

import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest
from harness_world import FULL, NAMES, read, small
from hypothesis import given
from hypothesis import strategies as st

from sysid_bench import words as words
from sysid_bench.errors import UsageError
from sysid_bench.harness.plan import cells_of_suite
from sysid_bench.harness.suite.load_suite import (
    load_suite,
    parse_stored,
    parse_suite,
    set_values,
    suite_text,
)
from sysid_bench.harness.suite.names import Names, default_names
from sysid_bench.plugin_names import resolve_files

SUITES = {
    "full": FULL,
    "small": small(),
    "sweeps": small(
        """[defaults]
        terms = [[], ["viscous"]]
        held_out = [["ptp"], [{ use = "fourier", period = 3 }]]
        prior = ["truth", "none", { com = 2 }]
        task = ["robot", "payload"]
        rate = [100, "1 kHz"]
        excitation = ["fourier", { use = "fourier", period = "3 s" }]
        plant = ["matched", "stribeck"]"""
    ),
}


@pytest.mark.parametrize("text", SUITES.values(), ids=SUITES)
def test_a_frozen_suite_reads_back_as_the_same(text: str) -> None:
    suite = parse_suite(text, "suite.toml", Path("/some/where"), NAMES)
    frozen = suite_text(suite)
    assert parse_suite(frozen, "run.toml", Path("/else/where"), NAMES) == suite
    assert parse_stored(frozen, "run.toml") == suite
    assert suite.folder == Path("/some/where")
    assert cells_of_suite(suite, NAMES) == cells_of_suite(parse_stored(frozen, "run.toml"), NAMES)


def test_the_folder_is_no_part_of_an_id() -> None:
    here, there = (
        cells_of_suite(parse_suite(FULL, "s", Path(p), NAMES), NAMES) for p in ("/a", "/b")
    )
    assert [cell.id for cell in here.cells] == [cell.id for cell in there.cells]


def test_lists_are_sweeps_but_for_keys_that_are_lists() -> None:
    one = read(
        small('[defaults]\nterms = ["viscous", "coulomb"]\nheld_out = ["ptp", "fourier"]')
    ).defaults
    assert one.terms == (("viscous", "coulomb"),)
    assert [[motion.use for motion in motions] for motions in one.held_out] == [["ptp", "fourier"]]
    two = read(SUITES["sweeps"]).defaults
    assert two.terms == ((), ("viscous",))
    assert [[motion.use for motion in motions] for motions in two.held_out] == [
        ["ptp"],
        ["fourier"],
    ]
    assert read(small()).defaults.terms == (None,)
    assert read(small("[defaults]\nterms = []")).defaults.terms == ((),)


# (what is written, what is written instead, a word of the key, a word of the message)
MISTAKES = [
    ("repeats = 3", 'repeats = "3"', "run.repeats", "'3'"),
    ('mass = "20 %"', 'mas = "20 %"', "defaults.prior.mas", "Did you mean 'mass'"),
    ('com = "15 mm"', 'com = "15 s"', "defaults.prior.com", "expected one of"),
    ('"ptp"]', '"ptpp"]', "defaults.held_out[1]", "Did you mean 'ptp'"),
    ('rate       = "200 Hz"', 'rate       = "200 Hx"', "defaults.rate", "kHz"),
    ('tau = "0.5 %"', 'tau = "-0.5 %"', "defaults.noise[1].tau", "0 or more"),
    ('task       = "robot"', 'task       = "robots"', "defaults.task", "Did you mean 'robot'"),
    ("terms      = []", 'terms      = ["viscus"]', "defaults.terms[0]", "'viscous'"),
    ('plant      = "matched"', 'plant      = "mached"', "defaults.plant", "'matched'"),
    ('use = "inverse"', 'use = "invers"', "defaults.simulation", "'inverse'"),
    ('"from q"', '"from p"', "defaults.signals.derivatives", "'from q'"),
    ('"ur5", "panda"', '"ur5", "pandda"', "robot[0].use[1]", "'panda'"),
    ('"sphere-1kg"', '"sfere-1kg"', "robot[0].payloads[1]", "'sphere-1kg'"),
    ("mass = 1.2", "mass = -1.2", "robot[0].payloads[2]", "must be positive"),
    ('payloads = ["none"]', 'paylods = ["none"]', "robot[1].paylods", "Did you mean 'payloads'"),
    ('use = "ols"', 'use = "olss"', "estimator[0]", "'ols'"),
    ("robot.free_base'", "robot.free_bas'", "exclude[0].when", "'robot.free_base'"),
    ("tolerance = 1e-12", "tolerance = 0", "crosscheck.tolerance", "positive"),
    ('"skip-robot"', '"skip"', "crosscheck.on_fail", "'skip-robot'"),
    ('rows    = ["robot"', 'rows    = ["robt"', "table[0].rows[0]", "'robot'"),
    (
        'metric = "torque_error", stat',
        'metric = "torque", stat',
        "table[0].cells.metric",
        "Did you mean 'torque_error'",
    ),
    ('"median"', '"medium"', "table[0].cells.stat", "'median'"),
    ("status != ", "statuss != ", "record.when", "'status'"),
    ("max_hz = 50", "max_hy = 50", "record.max_hy", "Did you mean 'max_hz'"),
    ('name   = "smoke"', 'name   = "smoke/../x"', "name", "smoke/../x"),
    ('timeout = "60 s"', 'timeout = "0 s"', "run.timeout", "positive"),
    ("period = ", "periods = 1979-05-27, period = ", "defaults.excitation", "JSON"),
]


@pytest.mark.parametrize(
    ("right", "wrong", "key", "reported"), MISTAKES, ids=[m[2] for m in MISTAKES]
)
def test_a_mistake_is_reported_with_its_line_and_what_there_is(
    right: str, wrong: str, key: str, reported: str
) -> None:
    place = FULL.rindex(right) if key == "robot[1].paylods" else FULL.index(right)
    at = FULL.count("\n", 0, place) + 1
    before, _, after = FULL.rpartition(right) if at > 30 else FULL.partition(right)
    text = f"{before}{wrong}{after}"
    with pytest.raises(UsageError) as caught:
        read(text)
    lines = str(caught.value).splitlines()
    assert len(lines) == 1
    where, _, rest = lines[0].partition(": ")
    assert where == f"suite.toml:{at}" or key.startswith("estimator")
    assert rest.startswith(f"{key}: ")
    assert reported in rest


def test_the_rule_for_limits_is_a_setting_of_every_excitation() -> None:
    marked = read(FULL.replace("period = ", 'limits = "mark", period = ', 1))
    assert any(entry.spec.get("limits") == "mark" for entry in marked.defaults.excitation)
    with pytest.raises(UsageError, match="There are: mark, refuse"):
        read(FULL.replace("period = ", 'limits = "ignore", period = ', 1))


def test_all_mistakes_are_reported_at_once() -> None:
    text = FULL
    single = [mistake for mistake in MISTAKES if FULL.count(mistake[0]) == 1]
    for right, wrong, _, _ in single:
        text = text.replace(right, wrong, 1)
    with pytest.raises(UsageError) as caught:
        read(text)
    reported = str(caught.value)
    for _, _, key, word in single:
        assert any(f": {key}: " in line and word in line for line in reported.splitlines()), key
    numbers = [int(line.split(":")[1]) for line in reported.splitlines()]
    assert numbers == sorted(numbers)


@pytest.mark.parametrize(
    ("text", "answer"),
    [
        ('robot = "a"\nfile = "a.csv"\nq = ["q1"]\ntau = ["t1"]', "a recording; it is not a suite"),
        ('name = "arm"\ntitle = "Arm"\nfile = "arm.urdf"', "not a suite: it has no schema"),
    ],
)
def test_a_file_of_another_kind_is_one_sentence(text: str, answer: str) -> None:
    with pytest.raises(UsageError, match=answer) as caught:
        read(text)
    assert "\n" not in str(caught.value)
    with pytest.raises(UsageError, match="unknown key"):
        read(f"schema = 1\n{text}")


@pytest.mark.parametrize("key", ["schema", "name", "robot", "estimator"])
def test_what_every_suite_needs(key: str) -> None:
    data = tomllib.loads(small())
    del data[key]
    with pytest.raises(UsageError, match=f"{key}: this key is missing"):
        parse_suite("\n".join(f"{k} = {_inline(v)}" for k, v in data.items()), names=NAMES)


def _inline(value: Any) -> str:
    if isinstance(value, list):
        return "[" + ", ".join(map(_inline, value)) + "]"
    if isinstance(value, Mapping):
        return "{ " + ", ".join(f"{k} = {_inline(v)}" for k, v in value.items()) + " }"
    return repr(value)


def test_an_empty_sweep_is_refused() -> None:
    with pytest.raises(UsageError, match=r"defaults\.noise: an empty sweep"):
        read(small("[defaults]\nnoise = []"))


def test_a_plugin_that_breaks_on_import_is_a_line_like_others(tmp_path: Path) -> None:
    (tmp_path / "mine.py").write_text("raise RuntimeError('bad day')")
    names = Names(NAMES.robot, NAMES.payload, default_names().plugin)
    estimators = '[[estimator]]\nuse = "file:mine.py:Mine"\n'
    text = small(
        '[defaults]\nplant = "file:good.py:Good"\nexcitation = "file:good.py:Good"\n'
        'held_out = "file:good.py:Good"\nsimulation = "file:good.py:Good"', estimators=estimators
    )  # fmt: skip
    (tmp_path / "good.py").write_text("class Good:\n    pass\n")
    with pytest.raises(UsageError) as caught:
        parse_suite(text, "suite.toml", tmp_path, names)
    assert len(str(caught.value).splitlines()) == 1
    assert "estimator[0]: importing or making it raised RuntimeError: bad day" in str(caught.value)


def test_plugin_files_are_found_from_the_suites_folder() -> None:
    spec = resolve_files({"use": "file:mine.py:Mine", "cut": 2}, Path("/suites"))
    assert spec == {"use": "file:/suites/mine.py:Mine", "cut": 2}
    assert resolve_files({"use": "mylab.methods:X"}, Path("/suites")) == {"use": "mylab.methods:X"}


def test_a_file_that_is_no_toml_or_no_file(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="not valid TOML"):
        read("name = ")
    with pytest.raises(UsageError, match="cannot be read"):
        load_suite(tmp_path / "absent.toml", NAMES)
    (tmp_path / "s.toml").write_text(small())
    assert load_suite(tmp_path / "s.toml", NAMES).folder == tmp_path


@pytest.mark.parametrize(
    ("text", "value"),
    [("7", 7), ('"100 Hz"', "100 Hz"), ("100 Hz", "100 Hz"), ("true", True), ("[1, 2]", [1, 2]),
     ("panda", "panda"), ("1\nx = 2", "1\nx = 2"), ("{ q = 1 }", {"q": 1})],
)  # fmt: skip
def test_settings_are_toml_or_else_texts(text: str, value: Any) -> None:
    assert set_values(FULL, {"defaults.rate": text})["defaults"]["rate"] == value


def test_settings_reach_everything_and_nothing_else() -> None:
    before = tomllib.loads(FULL)
    after = set_values(before, {"seed": "7", "robot.0.payloads": "[]", "record.new.deep": "1"})
    assert before == tomllib.loads(FULL)
    assert after["seed"] == 7
    assert after["robot"][0] == {**before["robot"][0], "payloads": []}
    assert after["record"]["new"] == {"deep": 1}
    assert after["defaults"] == before["defaults"]
    with pytest.raises(UsageError, match=r"--set name\.x"):
        set_values(before, {"name.x": "1"})
    for dotted in ("run..repeats", "." * 2000, "a" + ".a" * 2000):
        with pytest.raises(UsageError, match="up to 30 names"):
            set_values(before, {dotted: "1"})
    with pytest.raises(UsageError, match="unknown key"):
        parse_suite(FULL, names=NAMES, overrides={"sead": "7"})
    assert parse_suite(FULL, names=NAMES, overrides={"seed": "7"}).seed == 7


def test_words_are_those_of_the_other_packages() -> None:
    from sysid_bench.evaluation.repeat_statistic import WITH_BOUND
    from sysid_bench.metrics import METRICS, names_of
    from sysid_bench.models.manifest import TERMS
    from sysid_bench.reporting.tables import INTERVALS, STATISTICS

    assert set(words.TERMS) == set(TERMS)
    of_axes = {words.VERDICT, *names_of("joint")}
    of_axes |= {*names_of("interval"), *names_of("interval-repeats")}
    assert words.COVERAGE in names_of("interval")
    assert {*names_of("cell"), *names_of("repeats"), *of_axes} == set(METRICS)
    assert set(words.LEVEL_AXES) < {metric.level for metric in METRICS.values()}
    assert set(names_of("repeats")) == {"bias", *WITH_BOUND}
    assert set(words.STATISTICS) == set(STATISTICS)
    assert set(words.INTERVALS) == set(INTERVALS)


@given(st.text())
def test_any_text_is_read_or_refused(text: str) -> None:
    with pytest.raises(UsageError):
        read(text)


@pytest.mark.parametrize(
    ("metric", "column", "interval", "wrong"),
    [
        ("verdict", "parameter", "none", ""),
        ("verdict", "task", "none", "go together"),
        ("rank", "parameter", "none", "go together"),
        ("joint_error", "joint", "none", ""),
        ("joint_error", "task", "none", "go together"),
        ("rank", "joint", "none", "go together"),
        ("coverage", "std_from", "ci95", ""),
        ("coverage", "estimator", "ci95", "go together"),
        ("rank", "std_from", "none", "go together"),
        ("bias", "estimator", "ci95", ""),
        ("efficiency", "repeat", "ci95", "of all repeats together"),
        ("bound_ratio", "estimator", "iqr", "no interval but 'ci95'"),
    ],
)
def test_metrics_of_parameters_joints_and_repeats_need_their_axes(
    metric: str, column: str, interval: str, wrong: str
) -> None:
    text = small() + (
        f'[[table]]\nname = "t"\ncolumns = ["{column}"]\n'
        f'cells = {{ metric = "{metric}", interval = "{interval}" }}\n'
    )
    if not wrong:
        assert read(text).table[0].cells.metric == metric
        return
    with pytest.raises(UsageError, match=wrong):
        read(text)


@pytest.mark.parametrize(
    ("noise", "found"),
    [
        ('tau = "1 N m", tau_correlation = 0.98', {"tau": 1.0, "tau_correlation": 0.98}),
        ('tau = "1 N m", tau_correlation = "50 %"', {"tau": 1.0, "tau_correlation": 0.5}),
        ("tau_correlation = 0.9", {}),  # of no noise
    ],
)
def test_noise_may_have_a_memory_below_one(noise: str, found: dict[str, float]) -> None:
    (cell, *_) = cells_of_suite(read(small(f"[defaults]\nnoise = {{ {noise} }}")), NAMES).cells
    assert cell.spec.noise == found
    assert (cell.labels["noise"] == "exact") == (not found)
    with pytest.raises(UsageError, match="must be below 1; got 1"):
        read(small("[defaults]\nnoise = { tau_correlation = 1 }"))
