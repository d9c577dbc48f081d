"""A cluster for each test; without Dask the tests of this folder skip."""

from collections.abc import Iterator
from pathlib import Path

import pytest

pytest.importorskip("distributed", reason="the extra 'cluster' is not installed")

from tests.cluster.cluster_world import Cluster, bench, done, write_suite


@pytest.fixture
def cluster(tmp_path: Path) -> Iterator[Cluster]:
    (tmp_path / "cluster").mkdir()
    made = Cluster(tmp_path / "cluster")
    try:
        yield made
    finally:
        made.close()


@pytest.fixture(scope="session")
def suite(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The suite, in a folder of its own."""
    return write_suite(tmp_path_factory.mktemp("far") / "suite")


@pytest.fixture(scope="session")
def local(suite: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The run of one process of this machine."""
    out = tmp_path_factory.mktemp("local") / "run"
    done(bench("run", str(suite), "-o", str(out), "-j", "1"))
    return out
