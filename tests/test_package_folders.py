"""Folders of robots and suites: the nearest wins, both layouts are found, no data is missed."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from sysid_bench import package_folders
from sysid_bench.errors import UsageError

CHECKOUT = Path(__file__).parents[1]
KINDS = ("robots", "suites")


def robot(folder: Path, name: str) -> Path:
    manifest = folder / name / "robot.toml"
    manifest.parent.mkdir(parents=True)
    manifest.write_text(f'name = "{name}"\n')
    return manifest


def suite(folder: Path, name: str) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    file = folder / f"{name}.toml"
    file.write_text(f'name = "{name}"\n')
    return file


@pytest.fixture
def installation(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty installation: <folder>/sysid_bench, without robots and suites as yet."""
    package = tmp_path / "site" / "sysid_bench"
    package.mkdir(parents=True)
    monkeypatch.setattr(package_folders, "__file__", str(package / "package_folders.py"))
    return package


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty working folder."""
    folder = tmp_path / "work"
    folder.mkdir()
    monkeypatch.chdir(folder)
    return folder


@pytest.mark.parametrize("kind", KINDS)
def test_this_checkout_has_its_data(kind: str) -> None:
    assert package_folders.package_folder(kind) == CHECKOUT / kind


@pytest.mark.parametrize(
    "kind", ["robots", "suites", "data/collections", "data/datasets", "data/motors", "data/plants"]
)
def test_a_checkout_keeps_data_beside_the_package_and_a_wheel_inside(
    kind: str, installation: Path
) -> None:
    # Beside an installed package lies site-packages, where "robots" may be anybody's.
    for place in (installation.parent, installation):
        (place / kind).mkdir(parents=True)
        assert package_folders.package_folder(Path(kind).name) == place / kind


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.usefixtures("installation")
def test_an_installation_without_data_says_so(kind: str) -> None:
    with pytest.raises(UsageError, match=kind):
        package_folders.package_folder(kind)


def test_the_nearest_robot_of_a_name_wins(installation: Path, here: Path, tmp_path: Path) -> None:
    extra = tmp_path / "extra"
    for folder in (extra, here / "robots", installation / "robots"):
        robot(folder, "everywhere")
    for folder in (here / "robots", installation / "robots"):
        robot(folder, "here_and_there")
    robot(installation / "robots", "there")
    found = {name: file.resolve() for name, file in package_folders.robots(extra).items()}
    assert found == {
        "everywhere": extra / "everywhere" / "robot.toml",
        "here_and_there": here / "robots" / "here_and_there" / "robot.toml",
        "there": installation / "robots" / "there" / "robot.toml",
    }
    assert set(package_folders.robots()) == set(found)


def test_a_folder_without_a_manifest_is_no_robot(installation: Path, here: Path) -> None:
    (installation / "robots" / "bare").mkdir(parents=True)
    robot(here / "robots", "whole")
    assert set(package_folders.robots()) == {"whole"}


def test_a_folder_that_is_absent_is_left_out(installation: Path, here: Path) -> None:
    (installation / "robots").mkdir()
    assert package_folders.robot_folders(here / "absent") == [installation / "robots"]


def test_the_nearest_suite_of_a_name_wins(installation: Path, here: Path) -> None:
    mine = suite(here / "suites", "smoke")
    suite(installation / "suites", "smoke")
    theirs = suite(installation / "suites", "payload")
    assert package_folders.suite("smoke").resolve() == mine
    assert package_folders.suite("payload") == theirs


def test_a_path_of_a_suite_means_that_file(installation: Path, here: Path) -> None:
    suite(installation / "suites", "smoke")
    mine = suite(here, "smoke")
    assert package_folders.suite("smoke.toml").resolve() == mine
    assert package_folders.suite(str(mine)) == mine
    with pytest.raises(UsageError, match="is a folder"):
        package_folders.suite(str(here))


@pytest.mark.parametrize("name", ["smok", "smok.toml", "folder/smoke"])
@pytest.mark.usefixtures("here")
def test_a_suite_that_is_absent_is_answered_with_those_that_exist(
    name: str, installation: Path
) -> None:
    suite(installation / "suites", "smoke")
    with pytest.raises(UsageError) as error:
        package_folders.suite(name)
    assert repr(name) in str(error.value)
    assert "smoke" in str(error.value).replace(repr(name), "")


def test_example_robot_data_is_found_without_importing_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "example_robot_data", None)  # an import would raise
    package_folders.robot_data_folder.cache_clear()
    folder = package_folders.robot_data_folder()
    assert (folder / "panda_description" / "urdf" / "panda.urdf").is_file()


# --- Recorded data (tests/conftest.py) ----------------------------------------------------------

DATA_TESTS = """
import pytest

def test_fixture(data_folder):
    assert data_folder.is_dir()

def test_reason():
    pytest.skip("SYSID_BENCH_DATA holds no such recording")

@pytest.mark.skipif(True, reason="SYSID_BENCH_DATA by mark")
def test_mark():
    pass

def test_other_skip():
    pytest.skip("no graphics here")
"""
WHOLE_MODULE = """
import pytest
pytest.skip("SYSID_BENCH_DATA is no use here", allow_module_level=True)
"""


def outcome(folder: Path, data: str | None) -> tuple[int, str]:
    """Exit code and closing line of pytest on the tests above, under this project's conftest."""
    shutil.copy(CHECKOUT / "tests" / "conftest.py", folder)
    (folder / "test_data.py").write_text(DATA_TESTS)
    (folder / "test_whole.py").write_text(WHOLE_MODULE)
    settings = {key: value for key, value in os.environ.items() if not key.startswith("PYTEST_")}
    settings.pop("SYSID_BENCH_DATA", None)
    settings["PYTEST_DISABLE_PLUGIN_AUTOLOAD"] = "1"  # conftest.py alone is on trial
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "--rootdir", "."]
    done = subprocess.run(
        [*command, "--continue-on-collection-errors"],
        cwd=folder,
        env=settings | ({} if data is None else {"SYSID_BENCH_DATA": data}),
        text=True,
        capture_output=True,
        timeout=120,
    )
    return done.returncode, done.stdout.splitlines()[-1]


def test_without_the_variable_data_tests_skip(tmp_path: Path) -> None:
    code, line = outcome(tmp_path, None)
    assert code == 0
    assert line.startswith("5 skipped")


def test_with_the_variable_a_skip_for_want_of_data_is_a_failure(tmp_path: Path) -> None:
    code, line = outcome(tmp_path, str(tmp_path))
    assert code == 1
    assert line.startswith("1 failed, 1 passed, 1 skipped, 2 errors")


def test_a_variable_that_names_no_folder_is_a_failure(tmp_path: Path) -> None:
    code, line = outcome(tmp_path, str(tmp_path / "absent"))
    assert code == 1
    assert line.startswith("1 failed, 1 skipped, 3 errors")
