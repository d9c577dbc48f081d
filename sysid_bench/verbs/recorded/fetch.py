"""Fetch of a data set or of a collection of models: its files on this machine, checked."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from sysid_bench import package_folders
from sysid_bench.apps.surveys.collection import Collection, read_collection
from sysid_bench.apps.surveys.fetch_package import fetch_collection, package_folder
from sysid_bench.errors import count_text, unknown_name
from sysid_bench.models.data_sets import (
    MANIFEST,
    UNLICENSED,
    DataSetFiles,
    fetch_files,
    find_dataset,
    is_description_file,
)
from sysid_bench.verbs.result import Result

PACKAGES: Final = "the index of Python packages"
"""Origin of collections."""


@dataclass(frozen=True, eq=False, repr=False)
class FetchResult(Result):
    """A data set, or a collection of models, that is here: its licence and origin, and the place
    of each file; of a collection that of each package."""

    name: str
    licence: str
    origin: str
    files: dict[str, str]
    bytes: int

    def summary(self) -> str:
        """Places of the files, each once by its folder, and what to do with the set."""
        folders = dict.fromkeys(str(Path(place).parent) for place in self.files.values())
        where = ", ".join(folders)
        suite = f'  in a suite: [[log]] dataset = "{self.name}"'
        if not self.files:
            return (
                f"{self.name}: its files are used beside its description, unchecked; nothing was "
                f"copied, for it lists none ([[file]] path, sha256, bytes)\n{suite}"
            )
        if self.origin == PACKAGES:
            text = f"{len(self.files)} packages, {self.bytes / 1e6:.1f} MB, checked, in {where}"
            return f"{self.name}: {text}\n  next: sysid-bench survey {self.name}"
        count = count_text(len(self.files), "file")
        return f"{self.name}: {count}, {self.bytes / 1e6:.1f} MB, checked, in {where}\n{suite}"


def _licence_text(found: DataSetFiles) -> str:
    """Licence, origin and size of a data set, in one line."""
    described = found.described
    commit = f" @{described.commit}" if described.commit else ""
    licence = "no licence is stated" if described.licence == UNLICENSED else described.licence
    origin = described.origin or "this machine"
    return f"{described.name}: {licence}; from {origin}{commit}; {described.size / 1e6:.1f} MB"


def fetch(
    name: str | Path, out: str | Path | None = None, *, notice: Callable[[str], None] | None = None
) -> FetchResult:
    """Bring the files of a data set here and check them; a name, or a folder with dataset.toml; or
    the name of a collection of models, whose packages pip loads without their dependencies.

    Files come from beside the description, from the folder in SYSID_BENCH_DATA, from the cache, or
    from their origin. With `out` all are copied below that folder, which SYSID_BENCH_DATA may name
    later. `notice` is called with the licence before anything is loaded. Raises UsageError for an
    unknown set, a damaged file, a failed download, a full disk, and where files without a licence
    would have to be downloaded or copied.
    """
    collections = package_folders.collection_files()
    target = None if out is None else Path(out)
    if str(name) in collections:
        return _fetch_collection(read_collection(collections[str(name)]), target, notice)
    found = _found_dataset(str(name))
    if notice is not None:
        notice(_licence_text(found))
    places = fetch_files(found, target)
    described = found.described
    return FetchResult(
        name=described.name if found.has_name else str(name),
        licence=described.licence,
        origin=described.origin,
        files={path: str(place) for path, place in places.items()},
        bytes=described.size,
    )


def _found_dataset(name: str) -> DataSetFiles:
    """The data set of a name or folder; raises UsageError that names collections, too."""
    sets = package_folders.dataset_files()
    if name in sets or is_description_file(name):
        return find_dataset(name)
    known = {*sets, *package_folders.collection_files()}
    raise unknown_name(
        "data set or collection", name, known,
        f"All: sysid-bench list datasets, list collections. Or give a folder with a {MANIFEST}.",
    )  # fmt: skip


def _fetch_collection(
    collection: Collection, out: Path | None, notice: Callable[[str], None] | None
) -> FetchResult:
    folder = fetch_collection(collection, out, notice or (lambda text: None))
    places = {wheel.file: str(package_folder(folder, wheel)) for wheel in collection.wheel}
    licences = sorted({wheel.licence for wheel in collection.wheel})
    return FetchResult(
        name=collection.name,
        licence=", ".join(licences),
        origin=PACKAGES,
        files=places,
        bytes=collection.size,
    )
