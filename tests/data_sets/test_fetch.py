"""Files of data sets: all of them arrive whole, or one sentence says why, and no part stays."""

import errno
import hashlib
import shutil
from collections import namedtuple
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import sysid_bench
from sysid_bench.errors import UsageError
from sysid_bench.models import data_sets as fetch_files
from sysid_bench.models.data_sets import find_dataset
from tests.data_sets.conftest import Remote, Server

USAGE = namedtuple("USAGE", "total used free")


def files_below(folder: Path) -> dict[str, bytes]:
    """Contents of all files below a folder, hidden ones too."""
    found = (path for path in folder.rglob("*") if path.is_file())
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in found}


def test_all_files_are_loaded_once(remote: Remote, server: Server, tmp_path: Path) -> None:
    out = tmp_path / "out"
    notices: list[str] = []
    result = sysid_bench.fetch(remote.file, out, notice=lambda text: notices.append(text))
    assert files_below(out) == remote.contents
    assert result.files == {path: str(out / path) for path in remote.contents}
    assert "MIT" in notices[0]
    assert "github.com/me/mine" in notices[0]
    server.files.clear()
    sysid_bench.fetch(remote.file, out)
    assert sorted(server.asked) == ["a.csv", "b.csv"]


def test_the_cache_serves_without_a_connection(remote: Remote, server: Server) -> None:
    first = sysid_bench.fetch(remote.file)
    server.files.clear()
    assert sysid_bench.fetch(remote.file).files == first.files
    assert {path: Path(place).read_bytes() for path, place in first.files.items()} == (
        remote.contents
    )


def test_a_damaged_file_of_the_cache_is_loaded_again(remote: Remote) -> None:
    places = sysid_bench.fetch(remote.file).files
    Path(places["runs/a.csv"]).write_bytes(b"damaged")
    sysid_bench.fetch(remote.file)
    assert Path(places["runs/a.csv"]).read_bytes() == remote.contents["runs/a.csv"]


def twin(remote: Remote, server: Server, folder: Path) -> Remote:
    """A set of the same name and paths whose files have other contents."""
    folder.mkdir()
    contents = {path: content[::-1] for path, content in remote.contents.items()}
    text = remote.file.read_text()
    for path, content in contents.items():
        old = hashlib.sha256(remote.contents[path]).hexdigest()
        text = text.replace(old, hashlib.sha256(content).hexdigest())
        text = text.replace(f'origin = "{Path(path).name}"', f'origin = "twin-{Path(path).name}"')
        server.files[f"twin-{Path(path).name}"] = content
    (folder / "dataset.toml").write_text(text)
    return Remote(folder / "dataset.toml", contents)


def test_sets_with_the_same_paths_do_not_mix(
    remote: Remote, server: Server, tmp_path: Path
) -> None:
    other = twin(remote, server, tmp_path / "other")
    sysid_bench.fetch(other.file)
    first = find_dataset(str(remote.file))
    assert [file.path for file in first.missing()] == list(remote.contents)
    with pytest.raises(UsageError, match=r"'runs/a\.csv' is missing; run sysid-bench fetch"):
        first.file_of("runs/a.csv")
    sysid_bench.fetch(remote.file)
    for one in (remote, other):
        found = find_dataset(str(one.file))
        assert not found.missing()
        assert {path: found.file_of(path).read_bytes() for path in one.contents} == one.contents


def test_another_version_in_a_mirror_or_beside_is_not_taken(
    remote: Remote, server: Server, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    other = twin(remote, server, tmp_path / "other")
    sysid_bench.fetch(other.file, tmp_path / "mirror")
    with pytest.raises(UsageError, match=r"mirror/runs/a\.csv differs"):
        sysid_bench.fetch(remote.file, tmp_path / "mirror")  # which has those of the other
    assert files_below(tmp_path / "mirror") == other.contents
    for place in (tmp_path / "mirror", remote.file.parent):
        monkeypatch.setenv("SYSID_BENCH_DATA", str(tmp_path / "mirror"))
        with pytest.raises(UsageError, match=f"{place}/runs/a.csv is another version"):
            find_dataset(str(remote.file)).file_of("runs/a.csv")
        shutil.copytree(
            tmp_path / "mirror" / "runs", remote.file.parent / "runs", dirs_exist_ok=True
        )
    assert not find_dataset(str(other.file)).missing()


Fault = Callable[[Remote, Server, pytest.MonkeyPatch], Any]


def content(b: bytes) -> Fault:
    """The server has other contents of b.csv."""
    return lambda remote, server, patch: server.files.update({"b.csv": b})


def change(old: str, new: str) -> Fault:
    """The description of the set is another one."""
    return lambda remote, server, patch: remote.change(old, new)


def no_space_left(remote: Remote, server: Server, patch: pytest.MonkeyPatch) -> None:
    patch.setattr(shutil, "disk_usage", lambda path: USAGE(10**6, 10**6, 10))


def full_while_writing(remote: Remote, server: Server, patch: pytest.MonkeyPatch) -> None:
    load = fetch_files.fetch_file

    def loaded(url: str, part: Path, most: int) -> None:
        load(url, part, most)
        if url.endswith("b.csv"):
            part.write_bytes(b"half")
            raise OSError(errno.ENOSPC, "No space left on device")

    patch.setattr(fetch_files, "fetch_file", loaded)


@pytest.mark.parametrize(
    ("fault", "said", "kept"),
    [
        (content(b"5,6\n" * 7000), "damaged, or another version", ["runs/a.csv"]),
        (lambda remote, server, patch: server.cut.add("b.csv"), "was not loaded", ["runs/a.csv"]),
        (content(bytes(2**24)), "more than the 28000 bytes", ["runs/a.csv"]),
        (content(b"3,4\n" * 7000 + b"\n"), "more than the 28000 bytes", ["runs/a.csv"]),
        (lambda remote, server, patch: server.files.pop("b.csv"), "404", ["runs/a.csv"]),
        (no_space_left, "free space", []),
        (full_while_writing, "disk is full", ["runs/a.csv"]),
        (change('licence = "MIT"', 'licence = "none"'), "states no licence", []),
        (change('licence = "MIT"\n', ""), "licence is missing", []),
        (change('origin = "b.csv"\n', ""), "was converted", ["runs/a.csv"]),
        (change('path = "runs/b.csv"', 'path = "../b.csv"'), "below the folder", []),
        (change('path = "runs/b.csv"', 'path = "."'), "below the folder", []),
        (change("runs/b.csv", "runs/a.csv"), "two .* have the path 'runs/a.csv'", []),
    ],
)
def test_one_sentence_and_nothing_half_made(
    fault: Fault,
    said: str,
    kept: list[str],
    remote: Remote,
    server: Server,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    fault(remote, server, monkeypatch)
    out = tmp_path / "out"
    with pytest.raises(UsageError, match=said) as raised:
        sysid_bench.fetch(remote.file, out)
    assert "\n" not in str(raised.value)
    assert files_below(out) == {path: remote.contents[path] for path in kept}


def test_no_more_is_written_than_stated(server: Server, tmp_path: Path) -> None:
    server.files["long"] = bytes(2**24)
    with pytest.raises(UsageError, match="more than the 3 bytes"):
        fetch_files.fetch_file(f"{server.url}/long", tmp_path / "part", 3)
    assert (tmp_path / "part").stat().st_size <= 3


@pytest.mark.parametrize("name", ["b c.csv", "b#1.csv", "b?raw=1.csv", "50%25.csv", "bär/é.csv"])
def test_a_name_reaches_the_server_as_it_is(name: str, remote: Remote, server: Server) -> None:
    remote.change('origin = "b.csv"', f'origin = "{name}"')
    server.files[name] = server.files.pop("b.csv")
    sysid_bench.fetch(remote.file)
    assert name in server.asked


def test_a_file_in_place_of_the_folder_is_named(remote: Remote, tmp_path: Path) -> None:
    (tmp_path / "taken").write_text("")
    with pytest.raises(UsageError, match="taken is not a folder; choose another one with -o"):
        sysid_bench.fetch(remote.file, tmp_path / "taken" / "x")
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "runs").write_text("")
    with pytest.raises(UsageError, match="choose another folder with -o"):
        sysid_bench.fetch(remote.file, tmp_path / "out")


def test_an_interrupted_fetch_goes_on(remote: Remote, server: Server, tmp_path: Path) -> None:
    server.cut.add("b.csv")
    with pytest.raises(UsageError):
        sysid_bench.fetch(remote.file, tmp_path / "out")
    server.cut.clear()
    server.asked.clear()
    sysid_bench.fetch(remote.file, tmp_path / "out")
    assert server.asked == ["b.csv"]
    assert files_below(tmp_path / "out") == remote.contents


@pytest.mark.parametrize("licence", ["MIT", "none"])
def test_a_mirror_is_used_in_place(
    licence: str, remote: Remote, server: Server, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    remote.change('licence = "MIT"', f'licence = "{licence}"')
    mirror = tmp_path / "mirror"
    for path, content in remote.contents.items():
        (mirror / path).parent.mkdir(parents=True, exist_ok=True)
        (mirror / path).write_bytes(content)
    monkeypatch.setenv("SYSID_BENCH_DATA", str(mirror))
    result = sysid_bench.fetch(remote.file)
    assert result.files == {path: str(mirror / path) for path in remote.contents}
    assert not server.asked
    if licence == "none":
        with pytest.raises(UsageError, match="no licence"):
            sysid_bench.fetch(remote.file, tmp_path / "copy")
        assert not (tmp_path / "copy").exists()
    else:
        sysid_bench.fetch(remote.file, tmp_path / "copy")
        assert files_below(tmp_path / "copy") == remote.contents
    (mirror / "runs/a.csv").write_bytes(b"damaged")
    with pytest.raises(UsageError, match=r"mirror/runs/a\.csv differs"):
        sysid_bench.fetch(remote.file)
