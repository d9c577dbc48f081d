"""Look-up of data sets by name or path, and of the motions in them."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from sysid_bench import package_folders
from sysid_bench.errors import UsageError, unknown_name
from sysid_bench.input_files import is_file, is_folder
from sysid_bench.models.data_sets.data_folders import cache_folder, has_hash, source_folder
from sysid_bench.models.data_sets.dataset_file import DataFile, DataSet, read_dataset

SCHEME: Final = "dataset:"
"""Prefix of the robot of a data set ("dataset:ur10") and of its motions ("dataset:ur10/train")."""

MANIFEST: Final = "dataset.toml"
"""Description of a data set in a folder of one's own."""


@dataclass(frozen=True)
class DataSetFiles:
    """A data set and the file that describes it."""

    described: DataSet
    file: Path

    def file_of(self, path: str) -> Path:
        """Return where a file of the set is: beside its description, in the mirror or in the cache.

        Raises UsageError where it is in none of them; of a listed file with its size and SHA-256.
        """
        listed = {file.path: file for file in self.described.file}
        found = self.find(listed[path]) if path in listed else self._beside(path)
        if found is None and path not in listed:
            raise UsageError(
                f"The data set {self.described.name!r} has no {path!r} beside {self.file}, and "
                "no [[file]] of it has this path."
            )
        if found is None:
            others = self.candidates(path)
            state = f"{others[0]} is another version of it" if others else f"{path!r} is missing"
            raise UsageError(
                f"The data set {self.described.name!r} is not here: {state}; run "
                f"sysid-bench fetch {self.command_name}."
            )
        return found

    def _beside(self, path: str) -> Path | None:
        """Return the file or folder beside the description, None where there is none."""
        beside = self.file.parent / path
        return beside if is_file(beside) or is_folder(beside) else None

    @property
    def cache(self) -> Path:
        """Folder below the cache that sets with these files share, and no others."""
        return cache_folder() / f"{self.described.name}-{self.described.files_hash[:16]}"

    def candidates(self, path: str) -> list[Path]:
        """Return the files of a name, whatever they contain: beside, in mirror and cache."""
        folders = filter(None, (self.file.parent, source_folder(), self.cache))
        return [folder / path for folder in folders if is_file(folder / path)]

    def find(self, file: DataFile) -> Path | None:
        """Return the first file of this name that has its content, None where there is none."""
        places = self.candidates(file.path)
        return next((p for p in places if has_hash(p, file.bytes, file.sha256)), None)

    @property
    def has_name(self) -> bool:
        """True where the name of the set finds it."""
        return package_folders.dataset_files().get(self.described.name) == self.file

    @property
    def command_name(self) -> str:
        """Name of the set on the command line: its own, or the path of its description."""
        return self.described.name if self.has_name else str(self.file)

    def missing(self) -> list[DataFile]:
        """Return the listed files that are nowhere yet."""
        return [file for file in self.described.file if self.find(file) is None]

    def motion(self, name: str) -> dict[str, Any]:
        """Return the keys of the log description of a motion, with absolute paths.

        Raises UsageError for an unknown motion, and for files that are not here.
        """
        if name not in self.described.motions:
            raise unknown_name(
                f"motion of the data set {self.described.name!r}", name, self.described.motions
            )
        keys = merge_keys(self.described.log, self.described.motions[name])
        return {key: self._placed(value, key) for key, value in keys.items()}

    def _placed(self, value: Any, key: str) -> Any:
        """Return a value with the paths under keys `file` made absolute."""
        if isinstance(value, Mapping):
            return {inner: self._placed(one, inner) for inner, one in value.items()}
        return self._absolute(value) if key == "file" else value

    def _absolute(self, value: Any) -> Any:
        """Return the path of a file, or those of a list; anything else as it is."""
        if isinstance(value, str):
            return str(self.file_of(value).resolve())
        return [self._placed(one, "file") for one in value] if isinstance(value, list) else value


def merge_keys(shared: Mapping[str, Any], own: Mapping[str, Any]) -> dict[str, Any]:
    """Return shared keys with those of one motion in their place, signals key by key."""
    both = {
        key: {**shared[key], **value}
        for key, value in own.items()
        if isinstance(value, Mapping) and isinstance(shared.get(key), Mapping)
    }
    return {**shared, **own, **both}


def find_dataset(source: str, folder: Path | None = None) -> DataSetFiles:
    """Return the data set of a name, a folder with dataset.toml, or such a file ("file:" before a
    path is allowed), relative to `folder`; raises UsageError where there is none."""
    table = package_folders.dataset_files()
    if source in table:
        return DataSetFiles(read_dataset(table[source]), table[source])
    path = (folder or Path()) / source.removeprefix("file:")
    file = path / MANIFEST if is_folder(path) else path
    if is_file(file):
        return DataSetFiles(read_dataset(file), file)
    if is_description_file(source):
        written = source.removeprefix("file:")
        where = "" if folder is None or Path(written).is_absolute() else f" in {folder}"
        raise UsageError(
            f"{written!r}{where} is not a data set: that is a folder with a {MANIFEST}."
        )
    raise unknown_name("dataset", source, table, f"Or give a folder with a {MANIFEST}.")


def is_description_file(source: str) -> bool:
    """True where a data set is named by the place of its description."""
    return (
        source.startswith("file:")
        or "/" in source
        or source.endswith(".toml")
        or is_dataset(source)
    )


def is_dataset(source: str) -> bool:
    """True for a folder with dataset.toml, or such a file."""
    path = Path(source.removeprefix("file:"))
    return is_file(path / MANIFEST) or (path.name == MANIFEST and is_file(path))


def find_motion(reference: str, folder: Path | None = None) -> tuple[DataSetFiles, str]:
    """Return the data set and the name of the motion in "dataset:ur10/train".

    Raises UsageError for an unknown one; the recording itself need not be here.
    """
    source, _, motion = reference.removeprefix(SCHEME).rpartition("/")
    if not source:
        raise UsageError(f"{reference!r} names no motion; write 'dataset:NAME/MOTION'.")
    found = find_dataset(source, folder)
    if motion not in found.described.motions:
        raise unknown_name(f"motion of {source!r}", motion, found.described.motions)
    return found, motion
