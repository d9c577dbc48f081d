"""Surveys: every model has a row whatever happens, equal files count once, changes are named."""

import json
import shutil
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

import sysid_bench
from sysid_bench.apps.surveys.survey import (
    DISAGREE,
    OTHER,
    RAW,
    SurveyRecord,
    baseline_text,
    cause_of,
    compare_baseline,
    markdown,
    read_baseline,
)
from sysid_bench.errors import UsageError

BODY = "<body><joint axis='0 1 0'/><geom size='.1' pos='.2 0 0'/>{}</body>"
MODELS = {
    "arm.xml": f"<mujoco><worldbody>{BODY.format('')}</worldbody></mujoco>",
    "copy/arm.xml": f"<mujoco><worldbody>{BODY.format('')}</worldbody></mujoco>",
    "parts/body.xml": f"<mujocoinclude>{BODY.format('')}</mujocoinclude>",
    "scenes/scene.xml": "<mujoco><worldbody><include file='../parts/body.xml'/></worldbody>"
    "</mujoco>",
    "heavy.urdf": "<robot name='r'><link name='a'/><link name='b'/><joint name='j' type="
    "'continuous'><parent link='a'/><child link='b'/></joint></robot>",
    "broken.urdf": "<robot name='x'><link name='a'",
    "note.xml": "<package/>",
}  # fmt: skip


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Five distinct models in seven files, and an XML file that is none."""
    place = tmp_path_factory.mktemp("models")
    for name, text in MODELS.items():
        (place / name).parent.mkdir(exist_ok=True)
        (place / name).write_text(text)
    return place


@pytest.fixture(scope="module")
def result(folder: Path, tmp_path_factory: pytest.TempPathFactory) -> "sysid_bench.SurveyResult":
    request = sysid_bench.SurveyRequest(samples=2, workers=1)
    return sysid_bench.survey(folder, tmp_path_factory.mktemp("out"), request)


def test_every_distinct_model_has_a_row(result: "sysid_bench.SurveyResult") -> None:
    by_name = {model.name: model for model in result.surveyed}
    assert sorted(by_name) == ["arm.xml", "broken.urdf", "heavy.urdf", "scenes/scene.xml"]
    assert [name for name, model in by_name.items() if model.ok] == ["arm.xml", "scenes/scene.xml"]
    # Pinocchio reads massless links; files of the folder above are read below the source.
    assert [n for n, m in by_name.items() if m.is_loaded] == [
        "arm.xml",
        "heavy.urdf",
        "scenes/scene.xml",
    ]
    assert (result.models, result.ok, result.loadable, result.loadable_ok) == (4, 2, 3, 2)
    assert sum(result.causes.values()) == len(result.refused) == 2
    assert all(refusal["reason"] for refusal in result.refused)
    json.dumps(result.to_dict())


def test_a_survey_goes_on_where_it_was(
    folder: Path, tmp_path: Path, result: "sysid_bench.SurveyResult"
) -> None:
    """Rows of the same file and code stay; those of a changed file are computed again."""
    models, out = tmp_path / "models", tmp_path / "out"
    shutil.copytree(folder, models)
    shutil.copytree(result.folder, out)
    events: list[tuple[str, Mapping[str, Any]]] = []

    def listen(kind: str, data: Mapping[str, Any]) -> None:
        events.append((kind, data))

    request = sysid_bench.SurveyRequest(samples=2, workers=1)
    again = sysid_bench.survey(models, out, request, on_event=listen)
    assert [kind for kind, _ in events] == ["plan"]
    assert again.to_dict() | {"source": "", "folder": ""} == result.to_dict() | {
        "source": "", "folder": ""}  # fmt: skip
    (models / "broken.urdf").write_text(MODELS["heavy.urdf"].replace("'r'", "'s'"))
    changed = sysid_bench.survey(models, out, request, on_event=listen)
    assert {data["id"] for kind, data in events if kind == "row"} == {
        "broken.urdf", "engines broken.urdf"}  # fmt: skip
    assert changed.loadable == result.loadable + 1


@pytest.mark.long
def test_a_model_over_its_limit_costs_itself_alone(folder: Path, tmp_path: Path) -> None:
    """A chain of 300 joints takes half a minute; the small models take milliseconds."""
    models = tmp_path / "models"
    shutil.copytree(folder, models)
    bodies = ""
    for _ in range(300):
        bodies = BODY.format(bodies)
    (models / "large.xml").write_text(f"<mujoco><worldbody>{bodies}</worldbody></mujoco>")
    request = sysid_bench.SurveyRequest(samples=100, workers=2, timeout=2.0, engines=False)
    late = sysid_bench.survey(models, tmp_path / "out", request)
    by_name = {model.name: model for model in late.surveyed}
    assert [name for name, model in by_name.items() if model.ok] == ["arm.xml", "scenes/scene.xml"]
    assert by_name["large.xml"].cause == "no answer within the time limit"


def made(name: str, **fields: Any) -> SurveyRecord:
    """A model that is ok, with some fields changed."""
    row = {"id": name, "status": "ok", "reason": "", "nv": 2, "base_parameters": 7, "repairs": []}
    return SurveyRecord(name, {**row, **fields}, None)


REFUSED = {"status": "failed", "reason": "x.urdf has no moving joint.", "nv": None}
CHANGES = {
    "refused": (made("m", **REFUSED), True),
    "other degrees of freedom": (made("m", nv=3), True),
    "other rank": (made("m", base_parameters=6), True),
    "other repairs": (made("m", repairs=["a"]), True),
    "hang": (made("m", status="timeout", reason="longer", nv=None), True),
}


@pytest.mark.parametrize("name", CHANGES)
def test_a_baseline_names_what_got_worse_and_what_got_better(name: str, tmp_path: Path) -> None:
    changed, worse = CHANGES[name]
    before, still = made("m"), [made("a"), made("z", **REFUSED)]
    file = tmp_path / "baseline.json"
    file.write_text(baseline_text([before, *still]))
    known = read_baseline(file)
    assert compare_baseline(known, [before, *still]) == []
    (change,) = compare_baseline(known, [changed, *still])
    assert (change.model, change.worse) == ("m", worse)
    (gone,) = compare_baseline(known, still)
    assert (gone.model, gone.worse) == ("m", True)
    (new,) = compare_baseline(known, [before, made("new"), *still])
    assert (new.model, new.worse) == ("new", False)
    (healed,) = compare_baseline(known, [before, made("a"), made("z")])
    assert (healed.model, healed.worse) == ("z", False)


def test_a_line_of_a_baseline_is_a_model() -> None:
    models = [made(f"m{k}") for k in range(9)]
    lines = baseline_text(models).splitlines()
    other = baseline_text([*models[:4], made("m4", nv=5), *models[5:]]).splitlines()
    assert [a for a, b in zip(lines, other, strict=True) if a != b] == [
        line for line in lines if '"m4"' in line
    ]


def test_another_file_is_not_a_baseline(tmp_path: Path) -> None:
    for text in ("", "[]", "{}", '{"models": {"a": 1}}', '{"models": {"a": {}}}'):
        (tmp_path / "b.json").write_text(text)
        with pytest.raises(UsageError, match="--save"):
            read_baseline(tmp_path / "b.json")


def test_causes_tell_raw_exceptions_and_disagreement_from_sentences() -> None:
    assert cause_of(made("m").row) == ""
    assert cause_of(made("m", **REFUSED | {"reason": "ValueError: bad"}).row) == RAW
    assert cause_of(made("m", status="failed", reason="gap 1 is above 1e-12").row) == DISAGREE
    assert cause_of(made("m", **REFUSED | {"reason": "What no pattern knows."}).row) == OTHER
    assert cause_of(made("m", **REFUSED).row) == "no moving joint"


def test_the_report_lists_each_refusal_with_its_sentence() -> None:
    refused = made("p/bad|name.urdf", **REFUSED)
    engines = {"mujoco": 3, "pinocchio": "no"}
    text = markdown("Title", "command", [made("p/a"), replace(refused, engines=engines)])
    assert "| p/bad\\|name.urdf | no moving joint | x.urdf has no moving joint. |" in text
    assert "**0 ok (0.0%)**" in text


def test_an_unknown_source_is_a_sentence(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="wild"):
        sysid_bench.survey("wildd", tmp_path)
    with pytest.raises(UsageError, match="holds no URDF"):
        sysid_bench.survey(tmp_path, tmp_path / "out")
