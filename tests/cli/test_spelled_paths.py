"""Answers about a model file do not depend on how its path is spelled, or from where."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Final

import pytest

import sysid_bench
from sysid_bench.apps.twins.replay import Replay
from sysid_bench.experiments.spec import noise_seed
from sysid_bench.models.load import load_robot
from sysid_bench.models.manifest import find_manifest
from sysid_bench.models.model_record import seed_content
from sysid_bench.models.random_robot import random_robot

SPELLED: Final = {"advice", "file", "model", "robot", "seconds", "title"}
"""Fields that hold the path or the name as it was given (cures name the file), and a time."""

VERBS: Final[Mapping[str, Callable[[str, Path], Any]]] = {
    "identify": lambda model, out: sysid_bench.identify(model, noise={"tau": "1 %"}),
    "identify payload": lambda model, out: sysid_bench.identify(model, "payload", "sphere-1kg"),
    "basis": lambda model, out: sysid_bench.basis(model),
    "crosscheck": lambda model, out: sysid_bench.crosscheck(model),
    "lint": lambda model, out: {"findings": answer(sysid_bench.lint([model]).to_dict())},
    "excite": lambda model, out: sysid_bench.excite(
        sysid_bench.ExciteRequest(model, settings={"iterations": 2, "harmonics": 1, "period": 5.0})
    ),
}


def answer(value: Any) -> Any:
    """A result without the fields that name the file."""
    if isinstance(value, Mapping):
        return {key: answer(inner) for key, inner in value.items() if key not in SPELLED}
    return [*map(answer, value)] if isinstance(value, list | tuple) else value


@pytest.fixture
def model(tmp_path: Path) -> Path:
    """A model in a folder, with a link to it in another folder under another name."""
    file = tmp_path / "lab" / "arms" / "arm.xml"
    file.parent.mkdir(parents=True)
    file.write_text(random_robot(3), encoding="utf-8")
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "link.xml").symlink_to(file)
    return file


@pytest.mark.parametrize("verb", VERBS)
def test_an_answer_is_the_same_for_each_spelling_of_a_path(
    verb: str, model: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """All verbs find their model in the same way: one of them tries all spellings."""
    spellings = [
        (model.parent, "arm.xml"),
        (tmp_path / "other", "link.xml"),
        (model.parent, "./../arms/arm.xml"),
        (model.parent.parent, "arms/arm.xml"),
        (tmp_path, f"file:{model}"),
    ]
    found = []
    for folder, spelled in spellings if verb == "basis" else spellings[:2]:
        monkeypatch.chdir(folder)
        found.append(answer(VERBS[verb](spelled, tmp_path)))
    assert all(one == found[0] for one in found[1:])


def test_a_file_that_changes_is_read_again(model: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """And so is another file of the same name, in another working folder."""
    monkeypatch.chdir(model.parent)
    names = [*sysid_bench.identify("arm.xml").bodies]
    model.write_text(random_robot(4), encoding="utf-8")
    assert [*sysid_bench.identify("arm.xml").bodies] != names


def test_a_robot_in_a_copied_folder_gives_the_same_answer(model: Path, tmp_path: Path) -> None:
    found = []
    for name in ("one", "two"):
        folder = tmp_path / name
        folder.mkdir()
        (folder / "m.xml").write_bytes(model.read_bytes())
        keys = 'name = "arm"\nfile = "m.xml"\nterms = ["viscous"]\n'
        (folder / "robot.toml").write_text(keys, encoding="utf-8")
        found += [answer(sysid_bench.identify(f"{folder}{end}")) for end in ("", "/robot.toml")]
    assert all(one == found[0] for one in found[1:])


def test_seeds_follow_the_model_and_not_the_bytes_of_its_files(model: Path) -> None:
    """A comment or another indent leaves all numbers as they were."""
    text = model.read_text(encoding="utf-8")
    first = answer(sysid_bench.identify(model, noise={"tau": "1 %"}))
    for harmless in (
        text.replace("<worldbody", "<!-- measured in May -->\n<worldbody", 1),
        text.replace(">", ">\n  "),
    ):
        model.write_text(harmless, encoding="utf-8")
        assert answer(sysid_bench.identify(model, noise={"tau": "1 %"})) == first
    seeds = {seed_content(find_manifest(str(model)))}
    model.write_text(text.replace('mass="', 'mass="1', 1), encoding="utf-8")
    seeds.add(seed_content(find_manifest(str(model))))
    assert len(seeds) == 2
    assert all(seeds)


def test_replays_of_a_file_and_of_a_link_to_it_draw_the_same_noise(
    model: Path, tmp_path: Path
) -> None:
    spelled = (model, tmp_path / "other" / "link.xml")
    seeds = {noise_seed(Replay(load_robot(str(file)), {}).spec(200.0, 0)) for file in spelled}
    model.write_text(f"<!-- a comment -->{model.read_text(encoding='utf-8')}", encoding="utf-8")
    seeds.add(noise_seed(Replay(load_robot(str(model)), {}).spec(200.0, 0)))
    assert len(seeds) == 1
    named = Replay(load_robot("random:3"), {}).spec(200.0, 0)
    assert named.seeded_robot == "random:3"


def test_a_named_robot_keeps_its_seeds() -> None:
    for name in ("ur5", "random:7"):
        assert seed_content(find_manifest(name)) is None
