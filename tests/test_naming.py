"""Names become objects; built-in names match the folders; plug-in authors add names."""

import ast
import math
from importlib.metadata import EntryPoint, EntryPoints
from pathlib import Path

import pytest

from sysid_bench import plugin_names
from sysid_bench.errors import SHOWN, UsageError
from sysid_bench.models.motor_table import Motor
from sysid_bench.models.robot import RobotModel
from sysid_bench.plugin_names import BUILTIN, build, known, resolve
from sysid_bench.types import Metric

ROOT = Path(plugin_names.__file__).parent
ALL = [(kind, name) for kind, table in BUILTIN.items() for name in table]
PLUGIN = """
from dataclasses import dataclass, field

@dataclass(frozen=True)
class Filter:
    order: int
    cut: float = field(default=20.0, metadata={"unit": "Hz"})
    reach: float = field(default=0.0, metadata={"unit": "rad|m"})

def loose(first, **rest):
    return first, rest

CONSTANT = 7
"""


@pytest.fixture
def plugin(tmp_path: Path) -> str:
    """A file of a plug-in author, named as a user names it, without the object."""
    file = tmp_path / "mine.py"
    file.write_text(PLUGIN)
    return f"file:{file}"


def test_a_kind_of_two_words_is_written_with_a_hyphen() -> None:
    assert known("log-reader") == known("log_reader") != {}
    with pytest.raises(UsageError, match=r"No log-reader is called 'nunpy'.*'numpy'"):
        resolve("log_reader", "nunpy")


def modules(kind: str) -> set[str]:
    """Modules of the core's own plug-ins; an application registers others from its own folder."""
    found = {target.partition(":")[0] for target in BUILTIN[kind].values()}
    return {module for module in found if not module.startswith("sysid_bench.apps.")}


def parts(places: str) -> dict[str, Path]:
    """Dotted module -> file, for the files and the public modules of the folders of the package,
    separated by blanks."""
    files: list[Path] = []
    for place in map(ROOT.joinpath, places.split()):
        files += [place] if place.is_file() else sorted(place.glob("[!_]*.py"))
    inside = [file.relative_to(ROOT).with_suffix("").parts for file in files]
    return {
        ".".join(["sysid_bench", *names]): file for names, file in zip(inside, files, strict=True)
    }


def classes_with(file: Path, methods: set[str]) -> set[str]:
    """Public classes of a file that define one of the methods themselves; no protocols."""
    return {
        node.name
        for node in ast.parse(file.read_text(encoding="utf-8")).body
        if isinstance(node, ast.ClassDef)
        and not node.name.startswith("_")
        and not any("Protocol" in ast.unparse(base) for base in node.bases)
        and methods & {part.name for part in node.body if isinstance(part, ast.FunctionDef)}
    }


# --- The table and the folders ------------------------------------------------------------------


@pytest.mark.parametrize(("kind", "name"), ALL)
def test_a_builtin_name_stands_for_something_that_is_there(kind: str, name: str) -> None:
    module = BUILTIN[kind][name].partition(":")[0]
    file = ROOT.parent / Path(*module.split(".")).with_suffix(".py")
    assert file.is_file(), f"{kind} {name!r} points to {module}, and there is no such file"
    assert callable(resolve(kind, name))


@pytest.mark.parametrize(
    ("kind", "folder"),
    [
        ("estimator", "identification/estimators"),
        ("log_reader", "signals/log_readers"),
    ],
)
def test_every_file_of_a_folder_of_plugins_is_registered(kind: str, folder: str) -> None:
    # A shared helper of such a folder starts its name with an underscore.
    assert set(parts(folder)) == modules(kind)


@pytest.mark.parametrize(
    ("kind", "folder", "methods"),
    [
        ("estimator", "identification/estimators", {"solve", "fit"}),
        ("plant", "simulation/effects simulation/plant.py", {"prepare"}),
        ("model_error", "simulation/model_errors.py", {"apply"}),
        ("sensor_error", "simulation/sensor_errors.py", {"prepare"}),
        ("pipeline", "signals/pipelines.py", {"process"}),
        ("log_reader", "signals/log_readers", {"read"}),
        ("excitation", "excitation", {"design"}),
        ("task", "experiments/tasks apps/actuators/task.py", {"unknowns"}),
    ],
)
def test_every_class_that_keeps_a_contract_is_registered(
    kind: str, folder: str, methods: set[str]
) -> None:
    there = {
        f"{module}:{name}"
        for module, file in parts(folder).items()
        for name in classes_with(file, methods)
    }
    assert there <= set(BUILTIN[kind].values())
    assert modules(kind) <= set(parts(folder))


# --- Ways to name a thing -----------------------------------------------------------------------


def test_a_module_and_object_need_no_registration() -> None:
    assert resolve("estimator", "math:sqrt") is math.sqrt


def test_a_file_and_object_need_no_package(plugin: str) -> None:
    assert resolve("estimator", f"{plugin}:CONSTANT") == 7


def test_a_file_may_postpone_its_annotations(tmp_path: Path) -> None:
    file = tmp_path / "modern.py"
    file.write_text(
        "from __future__ import annotations\nfrom dataclasses import dataclass\n"
        "@dataclass(frozen=True)\nclass Thing:\n    cut: float = 1.0\n"
    )
    assert build("estimator", f"file:{file}:Thing").cut == 1.0


def install(monkeypatch: pytest.MonkeyPatch, name: str, target: str) -> None:
    point = EntryPoint(name, target, "sysid_bench.estimators")

    monkeypatch.setattr(plugin_names, "entry_points", lambda: EntryPoints([point]))


def test_an_entry_point_joins_by_its_name(monkeypatch: pytest.MonkeyPatch) -> None:
    install(monkeypatch, "geodesic", "math:hypot [extra]")
    assert resolve("estimator", "geodesic") is math.hypot
    assert known("estimator") == {**BUILTIN["estimator"], "geodesic": "math:hypot"}
    assert "geodesic" not in known("excitation")
    with pytest.raises(UsageError, match="Did you mean 'geodesic'"):
        resolve("estimator", "geodesik")


def test_an_entry_point_replaces_no_builtin_name(monkeypatch: pytest.MonkeyPatch) -> None:
    install(monkeypatch, "ols", "math:hypot")
    assert known("estimator") == BUILTIN["estimator"]
    assert resolve("estimator", "ols") is not math.hypot


def test_an_entry_point_without_an_object_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    install(monkeypatch, "geodesic", "math")
    with pytest.raises(UsageError, match=r"'geodesic'.*names 'math'.*'module:object'"):
        resolve("estimator", "geodesic")


# --- What is wrong is named ---------------------------------------------------------------------


@pytest.mark.parametrize(("kind", "name"), ALL)
def test_a_slip_is_answered_with_the_nearest_name_and_all_names(kind: str, name: str) -> None:
    with pytest.raises(UsageError) as error:
        resolve(kind, name + "x")
    message = str(error.value)
    shown_kind = kind.replace("_", "-")
    assert f"No {shown_kind} is called {name + 'x'!r}. Did you mean {name!r}?" in message
    shown = [other for other in BUILTIN[kind] if f" {other}," in message or f" {other}." in message]
    assert len(shown) == min(len(BUILTIN[kind]), SHOWN)
    assert "module:object" in message


@pytest.mark.parametrize(
    ("name", "culprit"),
    [
        ("math:no_such_function", "no_such_function"),
        ("no_such_package.methods:Thing", "no_such_package.methods"),
        ("math.deeper:Thing", "math.deeper"),
        ("file:nowhere/mine.py:Thing", "nowhere/mine.py"),
    ],
)
def test_a_path_that_leads_nowhere_is_named(name: str, culprit: str) -> None:
    with pytest.raises(UsageError, match=culprit):
        resolve("estimator", name)


@pytest.mark.parametrize("line", ["import no_such_requirement", "None.thing"])
def test_a_plugin_that_breaks_on_import_shows_its_own_error(line: str, tmp_path: Path) -> None:
    # Blaming the name would hide the plug-in's own mistake from its author.
    file = tmp_path / "broken.py"
    file.write_text(line)
    with pytest.raises((ModuleNotFoundError, AttributeError), match=r"no_such_requirement|thing"):
        resolve("estimator", f"file:{file}:Thing")


# --- Settings -----------------------------------------------------------------------------------


def test_settings_are_read_with_their_units(plugin: str) -> None:
    thing = build(
        "filter", {"use": f"{plugin}:Filter", "order": 4, "cut": "1 kHz", "reach": "5 mm"}
    )
    assert (thing.order, thing.cut, thing.reach) == (4, 1000.0, 0.005)


def test_a_label_is_no_setting(plugin: str) -> None:
    spec = {"use": f"{plugin}:Filter", "order": 2}
    # Compared as text: a file is read again each time, so its classes are not the same object.
    assert repr(build("filter", spec | {"label": "Mine"})) == repr(build("filter", spec))
    assert spec == {"use": f"{plugin}:Filter", "order": 2}


def test_a_name_alone_means_default_settings() -> None:
    assert build("excitation", "math:inf") == math.inf


def test_free_settings_reach_a_function_that_takes_them(plugin: str) -> None:
    built = build("filter", {"use": f"{plugin}:loose", "first": 1, "other": 2})
    assert built == (1, {"other": 2})


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"order": 4, "cutt": "1 kHz"}, r"setting of the filter .*'cutt'. Did you mean 'cut'"),
        ({"cut": "1 kHz"}, r"needs the settings order"),
        ({"order": 4, "cut": "1 m"}, r"cut: '1 m' has the unit 'm'"),
        ({"order": 4, "cut": True}, r"cut: True is not a quantity"),
    ],
)
def test_a_wrong_setting_is_named(settings: dict[str, object], message: str, plugin: str) -> None:
    with pytest.raises(UsageError, match=message):
        build("filter", {"use": f"{plugin}:Filter"} | settings)


def test_a_constant_takes_no_settings(plugin: str) -> None:
    with pytest.raises(UsageError, match="takes no settings"):
        build("filter", {"use": f"{plugin}:CONSTANT", "order": 4})


def test_settings_without_a_name_are_refused() -> None:
    with pytest.raises(UsageError, match="needs a name"):
        build("filter", {"order": 4})


def test_attributes_that_plug_ins_read_keep_their_names() -> None:
    """Names that plug-ins of others use on the values that they are given."""
    assert hasattr(RobotModel, "inertial_columns")
    assert hasattr(Metric, "heading")
    assert hasattr(Motor, "armature")
