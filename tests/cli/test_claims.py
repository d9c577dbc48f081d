"""`run --gate` and `claims`: verdicts from stored rows, exit codes, formats, mistakes."""

import json
import shutil
from pathlib import Path
from typing import get_args

import pytest

import sysid_bench
from sysid_bench.errors import UsageError
from sysid_bench.evaluation.robot_statistic import Verdict
from sysid_bench.harness.suite.load_suite import parse_suite, suite_text
from sysid_bench.package_folders import package_folder

from .conftest import FIRST_CLAIM, OTHER_CLAIMS, SUITE, Run

TESTED = SUITE + FIRST_CLAIM


def test_a_run_tests_its_claims_and_a_gate_that_fails_is_its_exit_code(copied: Path) -> None:
    done = sysid_bench.run(copied / "run", jobs=1, gate=True)
    assert done.exit_code == 1
    assert done.claims is not None
    assert done.to_dict()["claims"]["counts"] == dict.fromkeys(get_args(Verdict), 1)
    assert (
        "A gate fails: data-harm at matched (fails), "
        "one-robot at matched (open: 1 robot: no interval)." in done.summary()
    )


def test_a_gate_that_fails_is_the_exit_code(copied: Path, cli: Run) -> None:
    assert cli("claims", "run", "--gate").returncode == 1
    assert cli("claims", "run").returncode == 0
    (copied / "first.toml").write_text(TESTED)
    first = ("--suite", "first.toml")
    assert cli("claims", "run", *first, "--gate").returncode == 0
    found = json.loads(cli("claims", "run", *first, "--json").stdout)["claims"]
    assert [(claim["name"], claim["verdict"]) for claim in found] == [("data-help", "holds")]


def test_claims_of_a_suite_run_none_of_its_plug_ins(stored: Path, tmp_path: Path, cli: Run) -> None:
    (tmp_path / "mine.py").write_text("raise SystemExit('imported')\nclass Mine:\n    pass\n")
    plugin = '[[estimator]]\nuse = "file:mine.py:Mine"\n'
    (tmp_path / "own.toml").write_text(TESTED.replace("[[claim]]", f"{plugin}[[claim]]", 1))
    done = cli("claims", str(stored / "run"), "--suite", "own.toml")
    assert done.returncode == 0, done.stderr
    assert "1 holds" in done.stdout


def test_a_run_stores_its_claims(stored: Path) -> None:
    table = (stored / "run" / "tables" / "claims.md").read_text()
    assert "| data-help | matched | holds |" in table
    assert "Data help (nobody 2026)" in (stored / "run" / "report.html").read_text()


def test_verdicts_in_every_format(stored: Path, cli: Run) -> None:
    words = ("claims", str(stored / "run"))
    verdicts = ["holds", "fails", "open", "not testable", "withdrawn"]
    shown = json.loads(cli(*words, "--json").stdout)
    assert [claim["verdict"] for claim in shown["claims"]] == verdicts
    assert shown["failed"] == ["data-harm at matched", "one-robot at matched"]
    assert shown["claims"][2]["reason"] == "1 robot: no interval"
    assert shown["claims"][3]["reason"] == "needs a thermometer"
    assert shown["claims"][4]["reason"] == "its source was retracted"
    corrected = [claim["p_corrected"] for claim in shown["claims"]]
    assert corrected[:2] == [claim["p"] for claim in shown["claims"][:2]]  # both are alike
    assert corrected[2:] == [None, None, None]
    assert [claim["needed"] for claim in shown["claims"]] == [6, 6, 6, None, None]
    lines = cli(*words, "--format", "csv").stdout.splitlines()
    assert [line.split(",")[2] for line in lines[1:]] == verdicts
    assert r"\begin{table}" in cli(*words, "--format", "latex").stdout
    assert cli(*words, "--format", "xml").returncode == 2


def test_the_same_claim_of_two_runs_is_tested_once_on_both(stored: Path) -> None:
    result = sysid_bench.claims(stored / "run", stored / "run")
    found = [(claim["cells"], claim["count"]) for claim in result.claims]
    assert found == [(12, 6), (12, 6), (12, 1), (0, 0), (0, 0)]
    once = sysid_bench.claims(stored / "run")
    assert result.claims[0]["value"] == pytest.approx(once.claims[0]["value"])


def test_robots_of_several_runs_are_known_by_their_content(stored: Path, tmp_path: Path) -> None:
    """Two files of one stem are two robots."""
    second = Path(shutil.copytree(stored / "run", tmp_path / "run"))
    records = json.loads((second / "models.json").read_text())
    other = {name: record | {"hash": "0" * 16} for name, record in records.items()}
    (second / "models.json").write_text(json.dumps(other))
    same = sysid_bench.claims(stored / "run", stored / "run").claims
    found = sysid_bench.claims(stored / "run", second).claims
    assert [claim["count"] for claim in same] == [6, 6, 1, 0, 0]
    assert [claim["count"] for claim in found] == [6, 6, 2, 0, 0]


def test_claims_of_one_name_in_two_suites_stay_apart(stored: Path, tmp_path: Path) -> None:
    second = Path(shutil.copytree(stored / "run", tmp_path / "run"))
    frozen = parse_suite(TESTED.replace('"stored"', '"other"').replace("Data help", "Data rule"))
    text = suite_text(frozen).replace("threshold = [1.0]", "threshold = [0.0]")
    (second / "run.toml").write_text(text)
    result = sysid_bench.claims(stored / "run", second)
    named = {(claim["suite"], claim["name"]): claim for claim in result.claims}
    assert len(named) == len(result.claims) == 6
    assert named["stored", "data-help"]["verdict"] == "holds"
    assert named["other", "data-help"]["verdict"] == "fails"
    assert "other, data-help at matched" in result.failed
    for statement in ("stored, data-help: Data help (", "other, data-help: Data rule ("):
        assert statement in result.summary()


@pytest.mark.parametrize(
    ("before", "after", "reason"),
    [
        ('"wls"', '"iv"', "not testable: no rows of the claim"),
        ('over      = "repeat"', "", "open: 1 robot: no interval"),
        ('over      = "repeat"', 'over = "cell"', "open: 6 cells: no interval"),
        ("threshold = 1.0", "threshold = 0.0", "fails"),
    ],
)
def test_a_gate_that_does_not_hold_fails(
    before: str, after: str, reason: str, stored: Path, tmp_path: Path
) -> None:
    (tmp_path / "gate.toml").write_text(TESTED.replace(before, after))
    result = sysid_bench.claims(stored / "run", suite=tmp_path / "gate.toml")
    assert not result.ok
    assert f"data-help at {result.claims[0]['level']} ({reason}" in result.summary()


def test_claims_survive_the_frozen_suite() -> None:
    suite = parse_suite(TESTED + OTHER_CLAIMS)
    assert parse_suite(suite_text(suite)).claim == suite.claim


@pytest.mark.parametrize(
    ("before", "after", "message"),
    [
        ('"torque_error"', '"torque_eror"', "torque_error"),
        ('metric    = "torque_error"\n', "", "needs 'metric'"),
        ("against   = 'estimator == \"prior\"'\n", "", "needs 'against'"),
        ("threshold = 1.0", "threshold = [1.0, 2.0]", "threshold of 1 number"),
        ("threshold = 1.0", 'direction = "within"\nthreshold = [2.0, 1.0]', "lower first"),
        ("threshold = 1.0", "threshold = true", "a threshold is a number"),
        ('over      = "repeat"', 'level = "L7"', "L4"),
        ("gate      = true", 'gate = true\nmissing = "time"', "cannot be a gate"),
        ("'estimator == \"wls\"'", "'estimater == \"wls\"'", "estimator"),
        ("threshold = 1.0", 'threshold = 1.0\nstatistic = "share"', "share"),
    ],
)
def test_mistakes_in_a_claim_are_named(before: str, after: str, message: str) -> None:
    assert before in TESTED
    with pytest.raises(UsageError, match=r"claim\[0\]|claim") as raised:
        parse_suite(TESTED.replace(before, after, 1))
    assert message in str(raised.value)


def test_a_run_without_claims_says_so(stored: Path, tmp_path: Path) -> None:
    (tmp_path / "none.toml").write_text(SUITE)
    with pytest.raises(UsageError, match="no \\[\\[claim\\]\\]"):
        sysid_bench.claims(stored / "run", suite=tmp_path / "none.toml")


def test_published_claims_can_be_read_without_running_them() -> None:
    files = sorted((package_folder("suites") / "claims").glob("*.toml"))
    texts = [(file, file.read_text()) for file in files]
    # Recordings are not part of the package: their suite is read where they are.
    suites = [
        parse_suite(text, str(file), file.parent) for file, text in texts if "[[log]]" not in text
    ]
    claims = [claim for suite in suites for claim in suite.claim]
    assert len({claim.name for claim in claims}) >= 15
    assert all(claim.missing or claim.level or claim.select for claim in claims)
    assert sum(claim.gate for claim in claims) >= 3
