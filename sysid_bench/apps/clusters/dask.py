"""Executor: workers of a Dask scheduler (https://distributed.dask.org), extra `cluster`."""

import contextlib
import ipaddress
import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final, Self
from urllib.parse import parse_qsl

from sysid_bench.apps.clusters.batch import Batch, RunFiles, run_batch, run_files
from sysid_bench.apps.clusters.batch_run import ExecutorRun, OnAnswer
from sysid_bench.errors import UsageError, reason_of, unknown_name
from sysid_bench.extras import extra_module
from sysid_bench.harness.executor import RunEnd, Work
from sysid_bench.harness.work.supervise import OnEvent
from sysid_bench.units import quantity
from sysid_bench.version_fields import package_hash

NAMES: Final = ("shared", "other-code", "patience")


@dataclass(frozen=True)
class WorkerOptions:
    """`shared`: workers see the same files, so that nothing is sent; `other_code`: workers with
    other versions compute too; `patience` (s): time without any worker that ends the run."""

    shared: bool
    other_code: bool
    patience: float

    @classmethod
    def read(cls, given: Mapping[str, Any], patience: str) -> Self:
        """Return the options of a mapping, in which a flag is True, or "" as in "?shared".

        Raises UsageError for another name or value.
        """
        for name in given:
            if name not in NAMES:
                raise unknown_name("option of workers", name, NAMES)
        for name in NAMES[:2]:
            value = given.get(name, False)
            if value != "" and not isinstance(value, bool):
                raise UsageError(
                    f"{name} is {value!r}; it is a flag: '?{name}' in an address, {name} = true in "
                    "a file."
                )
        seconds = quantity(given.get("patience", patience), "s")
        if not seconds > 0:
            raise UsageError(f"patience is {given['patience']!r}; give a positive time, as '60 s'.")
        shared, other_code = (given.get(name, False) in ("", True) for name in NAMES[:2])
        return cls(shared, other_code, seconds)


_CONNECT_SECONDS: Final = 20.0
_LOST_SECONDS: Final = 5.0
"""Time without a scheduler after which it is lost."""
_LOOK_SECONDS: Final = 0.3
"""Time after which the scheduler is asked for its workers again."""


@dataclass(frozen=True)
class Dask:
    """Computes on the workers of a scheduler at `address`, "HOST:PORT", where they join and leave.

    Options follow it: "?shared" (workers see the same files: nothing is sent), "?other-code"
    (workers with other versions compute too; rows carry their machine), "?patience=60s" (time
    without any worker after which the run ends, resumable). Dask's protocol without TLS executes
    what anybody sends: hosts other than this one need `security = "tls"` ("dask+tls://"), with the
    certificates of Dask's configuration.
    """

    address: str = "127.0.0.1:8786"
    security: str = ""

    def __post_init__(self) -> None:
        if self.security not in ("", "tls"):
            raise UsageError(f"security is {self.security!r}; give 'tls', or leave it out.")
        _ = self._options
        name, _, port = self._host.rpartition(":")
        if not name or not port.isdigit() or not 0 < int(port) < 65536:
            raise UsageError(
                f"The address of a Dask scheduler is HOST:PORT, as dask://127.0.0.1:8786; got "
                f"{self._host!r}."
            )
        # Dask without TLS is unauthenticated pickle: who reaches the port runs code.
        if not self.security and not _is_here(name.strip("[]")):
            raise UsageError(
                f"dask://{self._host} is another host, and Dask without TLS executes what anybody "
                f"on the network sends. Use dask+tls://{self._host} with certificates "
                "(distributed.comm.tls in Dask's configuration), or a tunnel: ssh -L "
                f"{port}:127.0.0.1:{port} {name}, then dask://127.0.0.1:{port}."
            )

    @property
    def _host(self) -> str:
        return self.address.partition("?")[0]

    @property
    def _options(self) -> WorkerOptions:
        query = self.address.partition("?")[2]
        return WorkerOptions.read(dict(parse_qsl(query, keep_blank_values=True)), "60 s")

    def work(self, work: Work, on_event: OnEvent) -> RunEnd:
        """Connect, send the files of the run, and let the workers compute.

        Raises UsageError where no scheduler answers.
        """
        scheme = "tls" if self.security else "tcp"
        with open_dask(f"{scheme}://{self._host}", is_secure=bool(self.security)) as client:
            return run_on(client, work, on_event, self._options)


def run_on(client: Any, work: Work, on_event: OnEvent, options: WorkerOptions) -> RunEnd:
    """Run jobs on the workers of a client."""
    bundle = None if options.shared else run_files(work.folders)
    engine = _Engine(client, bundle, options.patience)
    return ExecutorRun(engine, work, on_event, "" if options.other_code else package_hash()).run()


@contextlib.contextmanager
def open_dask(address: Any, is_secure: bool) -> Any:
    """Yield a client of a scheduler, or of a cluster object; UsageError where none answers."""
    distributed = load_dask("distributed")
    security = distributed.Security(require_encryption=True) if is_secure else None
    try:
        client = distributed.Client(
            address, timeout=_CONNECT_SECONDS, security=security, set_as_default=False
        )
    except (OSError, TimeoutError, ValueError, TypeError) as error:
        host, _, port = str(address).rpartition("/")[2].rpartition(":")
        if not port.isdigit():  # a cluster of its own
            host, port = "127.0.0.1", "8786"
        raise UsageError(
            f"No Dask scheduler answers at {address} ({reason_of(error)}). Start one with 'dask "
            f"scheduler --host {host} --port {port}' and workers with 'dask worker {host}:{port} "
            "--nthreads 1', or see the documentation's page on clusters."
        ) from error
    try:
        yield client
    finally:
        with contextlib.suppress(Exception):  # its scheduler may be gone
            client.close(timeout=2)


def load_dask(name: str) -> Any:
    """Return a module of the extra `cluster`; UsageError where it is not installed."""
    return extra_module(name, "This executor")


@dataclass(eq=False)
class _Engine:
    client: Any
    bundle: RunFiles | None
    patience: float

    def __post_init__(self) -> None:
        self._sent: Any = None
        self._futures: set[Any] = set()
        self._last_worker = self._last_scheduler = time.monotonic()
        self._looked = float("-inf")
        self._workers: Mapping[str, int] = {}

    def submit(self, batch: Batch, worker: str, on_answer: OnAnswer) -> None:
        try:
            # The bundle at the workers, sent again where those that held it are gone
            if self.bundle is not None and (self._sent is None or self._sent.status != "finished"):
                # Once to all workers, not with each batch; not hashed, since it may have 1 GB.
                self._sent = self.client.scatter(self.bundle, broadcast=True, hash=False)
            # Dask neither joins equal batches (pure) nor retries: losses are counted here. The
            # worker is a wish, since it may be gone by now.
            future = self.client.submit(
                run_batch, batch, self._sent, pure=False, retries=0,
                workers=[worker], allow_other_workers=True,
            )  # fmt: skip
        except Exception as error:  # the engine's errors have no common type
            on_answer(error)
            return
        self._futures.add(future)

        def answer(done: Any) -> None:
            self._futures.discard(done)
            try:
                on_answer(done.result())
            except BaseException as error:
                on_answer(error)
            finally:
                with contextlib.suppress(Exception):
                    done.release()

        future.add_done_callback(answer)

    def workers(self) -> Mapping[str, int]:
        now = time.monotonic()
        if now - self._looked > _LOOK_SECONDS:
            # Asked now and then: each call is a round trip to the scheduler.
            self._looked, self._workers = now, {}
            if self.client.status == "running":
                with contextlib.suppress(Exception):  # its scheduler has just gone
                    found = self.client.scheduler_info(n_workers=-1).get("workers", {})
                    self._workers = {address: one["nthreads"] for address, one in found.items()}
        return self._workers

    def is_lost(self) -> str:
        now = time.monotonic()
        if self.client.status == "running":
            self._last_scheduler = now
        if self.workers():
            self._last_worker = now
        if now - self._last_scheduler > _LOST_SECONDS:
            return "The scheduler is gone."
        if now - self._last_worker > self.patience:
            return f"No worker for {self.patience:g} s."
        return ""

    def cancel(self) -> None:
        with contextlib.suppress(Exception):
            self.client.cancel(list(self._futures), force=True)


def _is_here(host: str) -> bool:
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False
