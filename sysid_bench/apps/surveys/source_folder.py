"""Folder of the models of a source: a collection, a package, or a folder."""

from pathlib import Path
from typing import Final

from sysid_bench import package_folders
from sysid_bench.apps.surveys.collection import read_collection
from sysid_bench.apps.surveys.fetch_package import collection_folder, missing_files
from sysid_bench.errors import UsageError, unknown_name
from sysid_bench.input_files import is_folder

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
