"""Collections of packages: read with all their mistakes, loaded whole or not at all."""

import hashlib
import os
import zipfile
from collections.abc import Callable
from pathlib import Path

import pytest

import sysid_bench
from sysid_bench import package_folders
from sysid_bench.errors import UsageError
from sysid_bench.models.collection import (
    Collection,
    PackageFile,
    collection_folder,
    missing_files,
    read_collection,
)

NAME = "small_arms-1.0-py3-none-any.whl"
PARTS = {
    "small_arms/arm.xml": "<mujoco/>",
    "small_arms/arm.py": "raise SystemExit",
    "small_arms/meshes/link.STL": "solid",
    "small_arms-1.0.dist-info/METADATA": "Metadata-Version: 2.1\nName: small-arms\nVersion: 1.0\n",
    "small_arms-1.0.dist-info/WHEEL": "Wheel-Version: 1.0\nRoot-Is-Purelib: true\n",
    "small_arms-1.0.dist-info/RECORD": "",
}


@pytest.fixture
def index(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with one wheel, which is all that pip finds; caches are below tmp_path."""
    folder = tmp_path / "index"
    folder.mkdir()
    with zipfile.ZipFile(folder / NAME, "w") as archive:
        for name, text in PARTS.items():
            archive.writestr(name, text)
    for variable in [name for name in os.environ if name.startswith("PIP_")]:
        monkeypatch.delenv(variable)
    monkeypatch.setenv("PIP_NO_INDEX", "1")
    monkeypatch.setenv("PIP_FIND_LINKS", str(folder))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.chdir(tmp_path)
    return folder


def collection_text(index: Path, change: Callable[[str], str] = str) -> str:
    """A collection of the wheel of an index."""
    (wheel,) = index.iterdir()
    data = wheel.read_bytes()
    text = (
        f'name = "small"\n[[wheel]]\nfile = "{NAME}"\nbytes = {len(data)}\n'
        f'sha256 = "{hashlib.sha256(data).hexdigest()}"\nlicence = "MIT"\n'
    )
    return change(text)


def place(tmp_path: Path, text: str) -> Path:
    file = tmp_path / "collections" / "small.toml"
    file.parent.mkdir(exist_ok=True)
    file.write_text(text)
    return file


def test_fetch_unpacks_models_and_no_code_and_does_it_once(tmp_path: Path, index: Path) -> None:
    place(tmp_path, collection_text(index))
    notices: list[str] = []
    result = sysid_bench.fetch("small", notice=notices.append)
    (folder,) = map(Path, result.files.values())
    found = {file.relative_to(folder).as_posix() for file in folder.rglob("*") if file.is_file()}
    assert found == {"small_arms/arm.xml", "small_arms/meshes/link.STL"}
    assert "MIT" in notices[0]
    assert "survey small" in result.summary()
    (index / NAME).unlink()
    assert sysid_bench.fetch("small", notice=notices.append).files == result.files
    assert len(notices) == 1


@pytest.mark.long
def test_a_wheel_of_another_platform_is_loaded_all_the_same(tmp_path: Path, index: Path) -> None:
    name = "small_arms-1.0-cp39-cp39-macosx_11_0_arm64.macosx_12_0_arm64.whl"
    (index / NAME).rename(index / name)
    place(tmp_path, collection_text(index, lambda text: text.replace(NAME, name)))
    (folder,) = sysid_bench.fetch("small").files.values()
    assert (Path(folder) / "small_arms" / "arm.xml").is_file()


@pytest.mark.long
@pytest.mark.parametrize(
    ("old", "new", "words"),
    [("sha256 = \"", "sha256 = \"00000000", "another file"), ("-1.0-", "-2.0-", "not loaded")],
)  # fmt: skip
def test_another_wheel_than_the_listed_one_is_refused_and_leaves_nothing(
    tmp_path: Path, index: Path, old: str, new: str, words: str
) -> None:
    def changed(text: str) -> str:
        line, quote = text.replace(old, new, 1), text.count('"')
        assert line != text
        assert line.count('"') == quote
        return line if old != 'sha256 = "' else _shortened(line)

    file = place(tmp_path, collection_text(index, changed))
    with pytest.raises(UsageError, match=words):
        sysid_bench.fetch("small")
    collection = read_collection(file)
    folder = collection_folder(collection)
    assert missing_files(collection) == list(collection.wheel)
    assert not folder.exists() or not list(folder.iterdir())


def _shortened(text: str) -> str:
    """Cut the hash to 64 digits again."""
    head, _, tail = text.partition('sha256 = "')
    digits, _, rest = tail.partition('"')
    return f'{head}sha256 = "{digits[:64]}"{rest}'


WRONG = {
    "no name": ('name = "small"', "", "name: Field required"),
    "no wheel": ("[[wheel]]", "[wheels]", "wheel: Field required"),
    "not a wheel": (NAME, "small.tar.gz", "wheel.0.file"),
    "no licence": ('licence = "MIT"', "", "wheel.0.licence"),
    "short hash": ('sha256 = "', 'sha256 = "0', "wheel.0.sha256"),
    "not TOML": ("[[wheel]]", "[[wheel", "not valid TOML"),
}


@pytest.mark.parametrize("name", WRONG)
def test_mistakes_of_a_collection_are_named(tmp_path: Path, index: Path, name: str) -> None:
    old, new, words = WRONG[name]
    file = place(tmp_path, collection_text(index, lambda text: text.replace(old, new, 1)))
    with pytest.raises(UsageError, match=words):
        read_collection(file)


def test_the_collections_of_this_project_keep_their_size_and_name_each_package_once() -> None:
    files = package_folders.package_folder("collections").glob("*.toml")
    collections = [read_collection(file) for file in files]
    assert "wild" in {collection.name for collection in collections}
    for collection in collections:
        packages = [wheel.package for wheel in collection.wheel]
        assert len(packages) == len(set(packages))
        assert collection.size < 2e9


def test_a_wheel_is_its_file_name() -> None:
    file = "bullet-3.2-1-cp311-cp311-manylinux_2_17_x86_64.manylinux2014_x86_64.whl"
    wheel = PackageFile(file=file, bytes=1, sha256="0" * 64, licence="Zlib")
    assert (wheel.package, wheel.version) == ("bullet", "3.2")
    assert Collection(name="x", wheel=(wheel,)).size == 1
