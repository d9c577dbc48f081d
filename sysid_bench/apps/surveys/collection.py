"""Collection of models: the contents of `data/collections/<name>.toml`, pinned wheels of Python."""

from pathlib import Path
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from sysid_bench.errors import UsageError
from sysid_bench.input_files import parse_toml, read_text


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
        return Collection.model_validate(parse_toml(read_text(file)))
    except OSError as error:
        raise UsageError(f"{file} cannot be read: {error.strerror or error}.") from error
    except ValidationError as error:
        raise UsageError(f"{file}: {'; '.join(map(_line, error.errors()))}.") from error
    except ValueError as error:
        raise UsageError(f"{file} is not valid TOML: {error}.") from error


def _line(problem: Any) -> str:
    """Return one sentence for one error of pydantic."""
    return f"{'.'.join(map(str, problem['loc']))}: {problem['msg']}"
