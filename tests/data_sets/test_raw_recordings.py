"""What `init log` makes of raw public recordings, against the descriptions of the data sets: right
without an edit where the files state all that is needed, else refused with what they lack."""

from pathlib import Path

import pytest

from reports.make.raw_recordings import RECORDINGS, verdict


@pytest.mark.data
@pytest.mark.long
@pytest.mark.parametrize("files", RECORDINGS)
def test_a_raw_recording_is_right_or_refused(
    files: str, data_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SYSID_BENCH_DATA", str(data_folder))
    assert not verdict(files, tmp_path / "a.toml").startswith("wrong")
