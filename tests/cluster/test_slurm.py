"""A real SLURM of two nodes: an array of shards, and Dask workers in its jobs, as one process."""

import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.cluster.cluster_world import ROOT, bench, done, free_port, rows, run_on

PROFILE = """
maximum   = 2
interface = "lo"
memory    = "1 GB"
walltime  = "00:20:00"
python    = "{python}"
shared_temp_directory = "{folder}"
log_directory = "{folder}"
job_script_prologue = ["export PYTHONPATH={root} NODE_LOGS={folder}/nodes"]
"""
NODES = {"node1", "node2"}


@pytest.fixture(scope="module")
def slurm(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """SLURM's daemons for this module; skips with the reason where they do not start."""
    folder = tmp_path_factory.mktemp("slurm")
    script = Path(__file__).parent / "start_slurm.sh"
    started = subprocess.run(
        ["bash", str(script), str(folder), str(free_port())], text=True, capture_output=True
    )
    if started.returncode:
        pytest.skip(f"SLURM does not start here: {started.stderr.strip()[-300:]}")
    os.environ["SLURM_CONF"] = str(folder / "slurm.conf")
    yield
    for name in ("slurmd-node1", "slurmd-node2", "slurmctld"):
        number = (folder / f"{name}.pid").read_text().strip()
        subprocess.run(["kill", number], check=True)
    del os.environ["SLURM_CONF"]


def nodes(folder: Path) -> set[str]:
    """Nodes on which the third-party metric was computed."""
    return {file.name for file in (folder / "nodes").iterdir()}


@pytest.mark.usefixtures("slurm")
def test_an_array_of_shards_merges_to_the_run_of_one_process(
    suite: Path, local: Path, tmp_path: Path
) -> None:
    part = f"{tmp_path}/part$SLURM_ARRAY_TASK_ID"
    line = (
        f"PYTHONPATH={ROOT} NODE_LOGS={tmp_path}/nodes {sys.executable} -m sysid_bench "
        f"run {suite} -o {part} --shard $SLURM_ARRAY_TASK_ID/2 -j 1"
    )
    (tmp_path / "nodes").mkdir()
    subprocess.run(
        ["sbatch", "--wait", "--array=1-2", f"--output={tmp_path}/%a.log", "--wrap", line],
        check=True,
        timeout=240,
    )
    parts = [str(tmp_path / f"part{i}") for i in (1, 2)]
    done(bench("merge", *parts, "-o", str(tmp_path / "merged")))
    assert rows(tmp_path / "merged") == rows(local)
    assert nodes(tmp_path) == NODES


@pytest.mark.usefixtures("slurm")
def test_dask_workers_in_jobs_give_the_rows_of_one_process(
    suite: Path, local: Path, tmp_path: Path
) -> None:
    profile = tmp_path / "profile.toml"
    profile.write_text(PROFILE.format(python=sys.executable, folder=tmp_path, root=ROOT))
    (tmp_path / "nodes").mkdir()
    done(run_on(f"slurm:{profile}", suite, tmp_path / "run"))
    assert rows(tmp_path / "run") == rows(local)
    assert nodes(tmp_path) == NODES


def test_a_profile_that_is_wrong_is_a_sentence(suite: Path, tmp_path: Path) -> None:
    text = done(run_on(f"slurm:{tmp_path / 'none.toml'}", suite, tmp_path / "run"), 2)
    assert "profile" in text
    (tmp_path / "p.toml").write_text('interface = "lo"\ncoers = 2\n')
    text = done(run_on(f"slurm:{tmp_path / 'p.toml'}", suite, tmp_path / "run"), 2)
    assert "coers" in text
