"""Executor: Dask workers in jobs of SLURM (https://jobqueue.dask.org), extra `cluster`."""

import subprocess
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from sysid_bench.apps.clusters.dask import NAMES, WorkerOptions, load_dask, open_dask, run_on
from sysid_bench.errors import UsageError, reason_of
from sysid_bench.harness.executor import RunEnd, Work
from sysid_bench.harness.work.supervise import OnEvent
from sysid_bench.input_files import read_data

_DEFAULTS: Final = {"cores": 1, "processes": 1, "memory": "4 GB", "walltime": "01:00:00"}

_BATCH_SECONDS: Final = "100ms"
"""Time of sent batches for which another job is worth while: it is below that of two batches, which
each job has, since most batches of a run wait here, where Dask does not see them."""


@dataclass(frozen=True)
class Slurm:
    """Computes in jobs that SLURM starts, each a Dask worker, as described in the TOML file
    `address`.

    Keys of the file: `maximum` (most jobs, 10), `patience` (time without any job, "1 h"), `shared`
    and `other-code` as for `dask`; all others are those of dask_jobqueue.SLURMCluster (`queue`,
    `account`, `cores`, `memory`, `walltime`, `interface` ...). Connections are encrypted with
    certificates made for this run, below `shared_temp_directory` (default: the working directory).
    """

    address: str

    def __post_init__(self) -> None:
        self._read()

    def work(self, work: Work, on_event: OnEvent) -> RunEnd:
        """Start jobs as there is work, at most `maximum`, and end them at the end."""
        profile, options, maximum = self._read()
        with _cluster(profile) as cluster:
            # Before the wait for workers: with a refused profile none would ever come.
            _check_job(cluster.job_script())
            # adapt and not scale: under scale a dead worker is not replaced (dask-jobqueue 611).
            cluster.adapt(minimum=1, maximum=maximum, target_duration=_BATCH_SECONDS)
            with open_dask(cluster, is_secure=False) as client:
                return run_on(client, work, on_event, options)

    def _read(self) -> tuple[Mapping[str, Any], WorkerOptions, int]:
        """Return the keys of SLURMCluster, those of workers, and the most jobs."""
        try:
            keys = {**_DEFAULTS, **tomllib.loads(read_data(Path(self.address)).decode())}
        except (OSError, ValueError) as error:
            raise UsageError(
                f"The profile {self.address!r} of SLURM cannot be read ({reason_of(error)}). Write "
                "a TOML file with queue, cores, memory and walltime: --executor slurm:profile.toml."
            ) from error
        maximum = keys.pop("maximum", 10)
        if isinstance(maximum, bool) or not isinstance(maximum, int) or maximum < 1:
            raise UsageError(f"{self.address}: maximum is {maximum!r}; give 1 job or more.")
        own: dict[str, Any] = {key: keys.pop(key) for key in NAMES if key in keys}
        return keys, WorkerOptions.read(own, "1 h"), maximum


def _check_job(script: str) -> None:
    """Raise UsageError where SLURM does not take such a job."""
    try:
        done = subprocess.run(
            ["sbatch", "--test-only"], input=script, text=True, capture_output=True, timeout=60
        )
    except (OSError, subprocess.TimeoutExpired) as error:
        raise UsageError(
            f"sbatch cannot be asked here ({reason_of(error)}); run on a machine that submits jobs."
        ) from error
    if done.returncode:
        mark = "#SBATCH "
        lines = [x.removeprefix(mark) for x in script.splitlines() if x.startswith(mark)]
        raise UsageError(
            f"SLURM does not take the jobs of the profile: {done.stderr.strip()[-300:]} Its script "
            f"begins with: {' '.join(lines)}"
        )


def _cluster(profile: Mapping[str, Any]) -> Any:
    jobqueue, distributed = load_dask("dask_jobqueue"), load_dask("distributed")
    settings: dict[str, Any] = {
        "shared_temp_directory": str(Path.cwd()),
        "protocol": "tls://",
        **profile,
    }
    try:
        settings.setdefault("security", distributed.Security.temporary())
        return jobqueue.SLURMCluster(**settings)
    except (TypeError, ValueError, OSError, RuntimeError) as error:
        reason = reason_of(error)[:200]
        raise UsageError(
            f"dask_jobqueue does not take the keys {', '.join(sorted(profile))}: {reason}"
        ) from error
