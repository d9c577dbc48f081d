"""Files of a data set: checked where they are, else copied or downloaded, whole or not at all."""

import errno
import shutil
from collections.abc import Sequence
from pathlib import Path
from tempfile import mkdtemp
from typing import Final
from urllib.parse import quote

from sysid_bench.errors import UsageError
from sysid_bench.input_files import is_file
from sysid_bench.models.data_sets.data_folders import has_hash
from sysid_bench.models.data_sets.dataset_file import DataFile
from sysid_bench.models.data_sets.find_dataset import DataSetFiles

TIMEOUT: Final = 30
"""Seconds without any byte after which a download has failed."""
CHUNK: Final = 1 << 16
"""Bytes that are written at a time."""


def fetch_files(found: DataSetFiles, out: Path | None) -> dict[str, Path]:
    """Return where each listed file of a data set is, after checking its SHA-256.

    Without `out` files of the mirror and of the cache are used where they are, and others are
    downloaded into the cache; with `out` all are copied there. Files that are already complete are
    not loaded again, so that an interrupted call goes on where it stopped. Raises UsageError for a
    file that is damaged or cannot be had, for data without a licence, and for a full disk.
    """
    target = found.cache if out is None else out
    places = {file.path: _present(found, file, out) for file in found.described.file}
    absent = [file for file in found.described.file if places[file.path] is None]
    _check_licence(found, absent)
    _check_space(absent, target)
    for file in absent:
        _fetch_file(found, file, target / file.path)
    return {path: place or target / path for path, place in places.items()}


def _present(found: DataSetFiles, file: DataFile, out: Path | None) -> Path | None:
    """Return the checked file where it need not be loaded, None where it must be."""
    if out is None:
        others = found.candidates(file.path)
    else:
        others = list(filter(is_file, [out / file.path]))
    place = next((other for other in others if _is_whole(other, file)), None)
    if place is not None or others in ([], [found.cache / file.path]):  # ours is loaded again
        return place
    raise UsageError(_damaged(found, file, f"{others[0]} differs from it"))


def _is_whole(place: Path, file: DataFile) -> bool:
    return has_hash(place, file.bytes, file.sha256)


def _damaged(found: DataSetFiles, file: DataFile, what: str) -> str:
    return (
        f"{file.path} of the data set {found.described.name!r} has the SHA-256 "
        f"{file.sha256[:12]}..., and {what}: it is damaged, or another version."
    )


def _check_licence(found: DataSetFiles, absent: Sequence[DataFile]) -> None:
    """Raise UsageError where files would be passed on that nobody has licensed."""
    if absent and not found.described.is_open:
        raise UsageError(
            f"The data set {found.described.name!r} states no licence and is neither downloaded "
            f"nor copied; get {absent[0].path} from {found.described.origin or 'its authors'} "
            "yourself, and name its folder in SYSID_BENCH_DATA."
        )


def _check_source(found: DataSetFiles, file: DataFile) -> None:
    """Raise UsageError for a file that is not on this machine and has no address."""
    if found.find(file) is None and not (found.described.url and file.origin):
        why = "was converted from the original" if found.described.url else "has no url"
        raise UsageError(
            f"{file.path} of the data set {found.described.name!r} {why} and cannot be "
            "downloaded; SYSID_BENCH_DATA must name a folder that has it."
        )


def _check_space(absent: Sequence[DataFile], target: Path) -> None:
    """Raise UsageError where the disk has less room than the files need."""
    needed = sum(file.bytes for file in absent)
    parent = next(folder for folder in (target, *target.absolute().parents) if folder.exists())
    if not parent.is_dir():
        raise UsageError(f"{parent} is not a folder; choose another one with -o.")
    free = shutil.disk_usage(parent).free
    if needed > free:
        raise UsageError(
            f"{parent} has {free / 1e6:.1f} MB of free space, and the files need "
            f"{needed / 1e6:.1f} MB; free some, or choose another folder with -o."
        )


def _fetch_file(found: DataSetFiles, file: DataFile, place: Path) -> None:
    """Copy or download a file beside its place, check it, and move it there."""
    _check_source(found, file)
    try:
        place.parent.mkdir(parents=True, exist_ok=True)
        folder = Path(mkdtemp(prefix=".fetch-", dir=place.parent))
    except OSError as error:
        raise UsageError(_failure(file, error)) from error
    try:
        _load_file(found, file, folder / "part")
        if not _is_whole(folder / "part", file):
            raise UsageError(_damaged(found, file, "what was loaded has another one"))
        (folder / "part").replace(place)
    except OSError as error:  # of the disk, and of the connection: requests' errors are its heirs
        raise UsageError(_failure(file, error)) from error
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _load_file(found: DataSetFiles, file: DataFile, part: Path) -> None:
    """Write the content of a file to `part`, from this machine where it is there."""
    here = found.find(file)
    if here is not None:
        shutil.copyfile(here, part)
        return
    fetch_file(found.described.url.rstrip("/") + "/" + quote(file.origin), part, file.bytes)


def fetch_file(url: str, part: Path, most: int) -> None:
    """Write what a server answers to a file, a part at a time; raises UsageError for more than
    `most` bytes, of which no more are written."""
    import requests

    with requests.get(url, stream=True, timeout=TIMEOUT) as response:
        response.raise_for_status()
        with part.open("wb") as file:
            for content in response.iter_content(CHUNK):
                if file.tell() + len(content) > most:
                    raise UsageError(
                        f"{url} has more than the {most} bytes that the data set states: it is "
                        "another version."
                    )
                file.write(content)


def _failure(file: DataFile, error: OSError) -> str:
    """Return one sentence about a file that could not be loaded."""
    if error.errno in (errno.ENOSPC, errno.EDQUOT):
        return f"The disk is full: {file.path} was not written; free some space and fetch again."
    reason = error.strerror or str(error).splitlines()[0]
    # Errors of the connection have no number; those of the disk stay when fetched again.
    advice = "fetch again to go on" if error.errno is None else "choose another folder with -o"
    return f"{file.path} was not loaded ({type(error).__name__}: {reason}); {advice}."
