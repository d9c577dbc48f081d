"""Published data sets: their files described, found on disk and fetched."""

import errno
import hashlib
import os
import re
import shutil
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from itertools import chain
from pathlib import Path, PurePosixPath
from tempfile import TemporaryDirectory
from typing import Annotated, Any, Final, Literal
from urllib.parse import quote

from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field, ValidationError

from sysid_bench import package_folders
from sysid_bench.errors import UsageError, unknown_name
from sysid_bench.input_files import file_hash, is_file, is_folder, read_toml

MIRROR: Final = "SYSID_BENCH_DATA"
"""Variable that names a folder with the files of data sets, as `fetch -o` writes it."""


def source_folder() -> Path | None:
    """Return the folder that MIRROR names, None where it is not set."""
    named = os.environ.get(MIRROR)
    return Path(named) if named else None


def cache_folder() -> Path:
    """Return the folder that `fetch` writes to: sysid-bench/datasets below XDG_CACHE_HOME, which is
    ~/.cache by default."""
    named = os.environ.get("XDG_CACHE_HOME")
    return (Path(named) if named else Path.home() / ".cache") / "sysid-bench" / "datasets"


@lru_cache(maxsize=1024)
def _hash(path: Path, changed: int, size: int) -> str:
    """SHA-256 of the file as last changed at `changed` (ns)."""
    return file_hash(path)


UNLICENSED: Final = "none"
"""Licence of data whose authors state none: they are used in place, never passed on."""

Split = Literal["another motion", "another day", "repetition", "blocks left out"]
"""Relation of the test to the training motions."""


def _relative(path: str) -> str:
    """Return a path below a folder of data; raises ValueError for one that leaves it."""
    parts = PurePosixPath(path)
    is_plain = path == str(parts) and path != "." and "\\" not in path
    if not is_plain or parts.is_absolute() or ".." in parts.parts:
        raise ValueError(f"must be a path below the folder of the data, with '/'; got {path!r}")
    return path


def _robot(value: Any) -> Any:
    # Before the union, each member of which would have an error of its own.
    if not isinstance(value, (str, dict)):
        raise ValueError(f"must be a name, or a table with the keys of a robot.toml; got {value!r}")
    return value


def _hexadecimal(text: str) -> str:
    if not re.fullmatch("[0-9a-f]{64}", text):
        raise ValueError(f"must be 64 hexadecimal digits; got {text!r}")
    return text


class _Table(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, defer_build=True)


class DataFile(_Table):
    """A file of a data set: its place, SHA-256 and size (bytes). `origin`: its path below the `url`
    of the set; empty for a file that was converted, which only a mirror has."""

    path: Annotated[str, AfterValidator(_relative)]  # below the folder of the data
    sha256: Annotated[str, AfterValidator(_hexadecimal)]  # 64 hexadecimal digits
    bytes: Annotated[int, Field(ge=0)]  # size
    origin: str = ""

    def is_at(self, place: Path) -> bool:
        """True where a place has a file of this content; its SHA-256 is taken once per change."""
        if not is_file(place):
            return False
        status = place.stat()
        size = status.st_size
        return size == self.bytes and _hash(place, status.st_mtime_ns, size) == self.sha256


class KnownPayload(_Table):
    """Names of two motions, without and with a payload of known mass (kg)."""

    empty: str  # motion without the payload
    loaded: str  # motion with it
    mass: Annotated[float, Field(gt=0, allow_inf_nan=False)]  # kg


class DataSet(_Table):
    """Recordings of one robot.

    `robot`: a name, or the keys of a robot.toml. `log`: keys that the log descriptions of all
    `motions` share. `train` and `test` name motions, `split` says how they are related, `repeats`
    names pairs of recordings of one motion. `accept`: contradictions that the data are known for.
    `pipeline`: the one that suits the recording, where it is not the default of suites.
    """

    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9][\w.-]*$")]
    """Word after `dataset:` in suites and commands."""
    title: str = ""  # one line about the recordings
    origin: str = ""  # who recorded them, and where they were published
    commit: str = ""  # version of the origin
    licence: Annotated[str, Field(min_length=1)]  # of the data; `none` where the authors state none
    url: str = ""  # address below which `fetch` finds the files
    rate: str = ""  # sampling rate of the recordings
    robot_type: str = ""  # shared by units of one type, which are not independent robots
    robot: Annotated[str | dict[str, Any], BeforeValidator(_robot)]
    train: Annotated[tuple[str, ...], Field(min_length=1)]
    test: tuple[str, ...] = ()
    split: Split = "another motion"
    repeats: tuple[tuple[str, str], ...] = ()
    accept: tuple[str, ...] = ()
    choose: tuple[str, ...] = ()  # candidates of joint terms and features
    pipeline: dict[str, Any] | None = None
    log: dict[str, Any] = Field(default_factory=dict)
    motions: Annotated[dict[str, dict[str, Any]], Field(min_length=1)]
    payload: tuple[KnownPayload, ...] = ()  # motions whose payload was weighed
    file: tuple[DataFile, ...] = ()  # every file, with what it must contain

    @property
    def is_open(self) -> bool:
        """True where the authors allow others to have the data."""
        return self.licence != UNLICENSED

    @property
    def size(self) -> int:
        """Bytes of all files."""
        return sum(file.bytes for file in self.file)

    @property
    def files_hash(self) -> str:
        """SHA-256 of paths and contents of all files."""
        lines = sorted(f"{file.sha256} {file.path}" for file in self.file)
        return hashlib.sha256("\n".join(lines).encode()).hexdigest()


def read_dataset(file: Path) -> DataSet:
    """Return the data set in a TOML file; raises UsageError with all its mistakes."""
    try:
        found = DataSet.model_validate(read_toml(file, UsageError))
    except ValidationError as error:
        lines = "; ".join(_line(problem) for problem in error.errors())
        raise UsageError(f"{file}: {lines}.") from error
    pairs = (*found.repeats, *((pair.empty, pair.loaded) for pair in found.payload))
    for name in chain(found.train, found.test, *pairs):
        if name not in found.motions:
            raise UsageError(f"{file}: {unknown_name('motion', name, found.motions)}")
    both = set(found.train) & set(found.test)
    if both:
        raise UsageError(f"{file}: {', '.join(sorted(both))}: in train and in test; choose one.")
    count = Counter(one.path for one in found.file)
    twice = sorted(path for path, number in count.items() if number > 1)
    if twice:
        raise UsageError(f"{file}: two [[file]] have the path {twice[0]!r}; drop one.")
    return found


def _line(problem: Mapping[str, Any]) -> str:
    """Return one sentence for one error of pydantic."""
    key = ".".join(map(str, problem["loc"]))
    if problem["type"] == "extra_forbidden":
        *place, name = problem["loc"]
        tables: dict[str, type[BaseModel]] = {"file": DataFile, "payload": KnownPayload}
        known = tables.get(place[0], DataSet) if place else DataSet
        return f"{key}: {unknown_name('key', str(name), known.model_fields)}".rstrip(".")
    if problem["type"] == "missing":
        licence = f"; write its SPDX name, or '{UNLICENSED}' where none is stated"
        return f"{key} is missing{licence if key == 'licence' else ''}"
    return f"{key}: {problem['msg'].removeprefix('Value error, ')}"


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
        if path not in listed:
            try:
                # A set of this package may name a model of its robots.
                beside = self.file.parent / (path if self.has_name else _relative(path))
            except ValueError as error:
                raise UsageError(f"{self.file}: a file of a motion {error}.") from error
            if is_file(beside) or is_folder(beside):
                return beside
            raise UsageError(
                f"The data set {self.described.name!r} has no {path!r} beside {self.file}, and "
                "no [[file]] of it has this path."
            )
        found = self.find(listed[path])
        if found is None:
            others = self.candidates(path)
            state = f"{others[0]} is another version of it" if others else f"{path!r} is missing"
            raise UsageError(
                f"The data set {self.described.name!r} is not here: {state}; run "
                f"sysid-bench fetch {self.command_name}."
            )
        return found

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
        return next(filter(file.is_at, self.candidates(file.path)), None)

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
        if key != "file":
            return value
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


TIMEOUT: Final = 30
"""Seconds without any byte after which a download has failed."""


def fetch_files(found: DataSetFiles, out: Path | None) -> dict[str, Path]:
    """Return where each listed file of a data set is, after checking its SHA-256.

    Without `out` files of the mirror and of the cache are used where they are, and others are
    downloaded into the cache; with `out` all are copied there. Files that are already complete are
    not loaded again, so that an interrupted call goes on where it stopped. Raises UsageError for a
    file that is damaged or cannot be had, for data without a licence, and for a full disk.
    """
    target = found.cache if out is None else out
    places = {file.path: _complete_file(found, file, out) for file in found.described.file}
    absent = [file for file in found.described.file if places[file.path] is None]
    # A copy or download would pass on what nobody has licensed; files of the user's own are read.
    if absent and not found.described.is_open:
        raise UsageError(
            f"The data set {found.described.name!r} states no licence and is neither downloaded "
            f"nor copied; get {absent[0].path} from {found.described.origin or 'its authors'} "
            "yourself, and name its folder in SYSID_BENCH_DATA."
        )
    # Before the first byte: a full disk would be found only after the download of gigabytes.
    _check_space(target, sum(file.bytes for file in absent))
    for file in absent:
        _fetch_file(found, file, target / file.path)
    return {path: place or target / path for path, place in places.items()}


def _complete_file(found: DataSetFiles, file: DataFile, out: Path | None) -> Path | None:
    """Path of a file that is complete, in `out` if given; None where it has to be loaded."""
    others = found.candidates(file.path)
    if out is not None:
        others = list(filter(is_file, [out / file.path]))
    place = next(filter(file.is_at, others), None)
    if place is None and others not in ([], [found.cache / file.path]):  # ours is loaded again
        raise UsageError(_damaged(found, file, f"{others[0]} differs from it"))
    return place


def _check_space(target: Path, needed: int) -> None:
    """Refuse a folder whose disk has less than the bytes needed."""
    parent = next(folder for folder in (target, *target.absolute().parents) if folder.exists())
    if not parent.is_dir():
        raise UsageError(f"{parent} is not a folder; choose another one with -o.")
    free = shutil.disk_usage(parent).free
    if needed > free:
        raise UsageError(
            f"{parent} has {free / 1e6:.1f} MB of free space, and the files need "
            f"{needed / 1e6:.1f} MB; free some, or choose another folder with -o."
        )


def _damaged(found: DataSetFiles, file: DataFile, what: str) -> str:
    return (
        f"{file.path} of the data set {found.described.name!r} has the SHA-256 "
        f"{file.sha256[:12]}..., and {what}: it is damaged, or another version."
    )


def _fetch_file(found: DataSetFiles, file: DataFile, place: Path) -> None:
    """Copy or download a file beside its place, check it, and move it there: an interrupted call
    leaves no half file under the name of a whole one."""
    here = found.find(file)
    if here is None and not (found.described.url and file.origin):
        why = "was converted from the original" if found.described.url else "has no url"
        raise UsageError(
            f"{file.path} of the data set {found.described.name!r} {why} and cannot be "
            "downloaded; SYSID_BENCH_DATA must name a folder that has it."
        )
    try:
        place.parent.mkdir(parents=True, exist_ok=True)
        with TemporaryDirectory(
            prefix=".fetch-", dir=place.parent, ignore_cleanup_errors=True
        ) as folder:
            part = Path(folder) / "part"
            if here is not None:
                shutil.copyfile(here, part)
            else:
                address = found.described.url.rstrip("/") + "/" + quote(file.origin)
                fetch_file(address, part, file.bytes)
            if not file.is_at(part):
                raise UsageError(_damaged(found, file, "what was loaded has another one"))
            part.replace(place)
    except OSError as error:  # of the disk, and of the connection: requests' errors are its heirs
        if error.errno in (errno.ENOSPC, errno.EDQUOT):
            raise UsageError(
                f"The disk is full: {file.path} was not written; free some space and fetch again."
            ) from error
        reason = error.strerror or str(error).splitlines()[0]
        # Errors of the connection have no number; those of the disk stay when fetched again.
        advice = "fetch again to go on" if error.errno is None else "choose another folder with -o"
        raise UsageError(
            f"{file.path} was not loaded ({type(error).__name__}: {reason}); {advice}."
        ) from error


def fetch_file(url: str, part: Path, most: int) -> None:
    """Write what a server answers to a file, a part at a time; raises UsageError for more than
    `most` bytes, of which no more are written."""
    import requests

    with requests.get(url, stream=True, timeout=TIMEOUT) as response:
        response.raise_for_status()
        with part.open("wb") as file:
            for content in response.iter_content(1 << 16):
                if file.tell() + len(content) > most:
                    raise UsageError(
                        f"{url} has more than the {most} bytes that the data set states: it is "
                        "another version."
                    )
                file.write(content)
