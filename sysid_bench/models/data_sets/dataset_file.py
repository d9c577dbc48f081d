"""Data set: the contents of `data/datasets/<name>.toml`, or of a `dataset.toml` of one's own."""

import hashlib
import re
from collections import Counter
from collections.abc import Mapping
from itertools import chain
from pathlib import Path, PurePosixPath
from typing import Annotated, Any, Final, Literal

from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field, ValidationError

from sysid_bench.errors import UsageError, unknown_name
from sysid_bench.input_files import parse_toml, read_text

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


def _hash(text: str) -> str:
    if not re.fullmatch("[0-9a-f]{64}", text):
        raise ValueError(f"must be 64 hexadecimal digits; got {text!r}")
    return text


class _Table(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, defer_build=True)


class DataFile(_Table):
    """A file of a data set: its place, SHA-256 and size (bytes). `origin`: its path below the `url`
    of the set; empty for a file that was converted, which only a mirror has."""

    path: Annotated[str, AfterValidator(_relative)]  # below the folder of the data
    sha256: Annotated[str, AfterValidator(_hash)]  # 64 hexadecimal digits
    bytes: Annotated[int, Field(ge=0)]  # size
    origin: str = ""


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
        found = DataSet.model_validate(parse_toml(read_text(file)))
    except OSError as error:
        raise UsageError(f"{file} cannot be read: {error.strerror or error}.") from error
    except ValidationError as error:
        lines = "; ".join(_line(problem) for problem in error.errors())
        raise UsageError(f"{file}: {lines}.") from error
    except ValueError as error:
        raise UsageError(f"{file} is not valid TOML: {error}.") from error
    _check_motions(found, file)
    _check_paths(found, file)
    return found


def _check_paths(found: DataSet, file: Path) -> None:
    """Raise UsageError for two files at one place."""
    count = Counter(one.path for one in found.file)
    twice = sorted(path for path, number in count.items() if number > 1)
    if twice:
        raise UsageError(f"{file}: two [[file]] have the path {twice[0]!r}; drop one.")


def _check_motions(found: DataSet, file: Path) -> None:
    """Raise UsageError for a motion that is named and not described."""
    pairs = (*found.repeats, *((pair.empty, pair.loaded) for pair in found.payload))
    for name in chain(found.train, found.test, *pairs):
        if name not in found.motions:
            raise UsageError(f"{file}: {unknown_name('motion', name, found.motions)}")
    both = set(found.train) & set(found.test)
    if both:
        raise UsageError(f"{file}: {', '.join(sorted(both))}: in train and in test; choose one.")


_TABLES: Final[Mapping[str, type[BaseModel]]] = {"file": DataFile, "payload": KnownPayload}
_ADVICE: Final = {
    "licence": f"; write its SPDX name, or '{UNLICENSED}' where none is stated",
}
"""Continuation of the message on a missing key."""


def _line(problem: Mapping[str, Any]) -> str:
    """Return one sentence for one error of pydantic."""
    key = ".".join(map(str, problem["loc"]))
    if problem["type"] == "extra_forbidden":
        *place, name = problem["loc"]
        known = _TABLES.get(place[0], DataSet) if place else DataSet
        return f"{key}: {unknown_name('key', str(name), known.model_fields)}".rstrip(".")
    if problem["type"] == "missing":
        return f"{key} is missing{_ADVICE.get(key, '')}"
    return f"{key}: {problem['msg'].removeprefix('Value error, ')}"
