"""Tasks over a Dask cluster: one on this machine alone, or one whose scheduler is named.

Whoever reaches a scheduler or a worker can run code on it.  The local cluster listens on 127.0.0.1 alone.
"""

from __future__ import annotations

import ipaddress
import logging
import os
import uuid
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.util import find_spec
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

from station.campaign.outcome import Task
from station.campaign.processes import RETRIES, Work, lost_line
from station.errors import UsageError, WorkError
from station.estimation.pool import ONE_THREAD

if TYPE_CHECKING:
    from distributed import Client

LOCAL = "127.0.0.1"
PATIENCE = 15.0
"""Seconds that a scheduler is given to answer."""


@dataclass(frozen=True)
class Scheduler:
    """A scheduler's address and, for tls://, the files that the two sides know each other by (PEM)."""

    address: str
    ca: Path | None = None
    cert: Path | None = None
    key: Path | None = None

    def __post_init__(self) -> None:
        try:
            parts = urlsplit(self.address)
            whole = parts.scheme in ("tcp", "tls") and parts.hostname and parts.port and not parts.path
        except ValueError:
            whole = False
        if not whole:
            raise UsageError(f"--scheduler {self.address}: an address such as tls://host:8786 is wanted")
        files = {"--tls-ca": self.ca, "--tls-cert": self.cert, "--tls-key": self.key}
        for option, path in files.items():
            if parts.scheme == "tls" and path is None:
                raise UsageError(f"{option}: missing; a tls:// scheduler wants --tls-ca, --tls-cert and --tls-key")
            if parts.scheme == "tcp" and path is not None:
                raise UsageError(f"{option}: of no use with tcp://; give --scheduler tls://...")
            if path is not None and not path.is_file():
                raise UsageError(f"{option} {path}: no such file")

    @property
    def warning(self) -> str | None:
        """What to know before using it: None for tls:// and on this machine."""
        parts = urlsplit(self.address)
        try:
            near = parts.hostname == "localhost" or ipaddress.ip_address(parts.hostname or "").is_loopback
        except ValueError:
            near = False
        if parts.scheme == "tls" or near:
            return None
        return (f"{self.address}: neither encrypted nor checked; whoever reaches this scheduler can run code on its "
                "workers and on this machine (tls:// prevents that)")


def available() -> bool:
    """Whether Dask's distributed is installed."""
    return find_spec("distributed") is not None


def need() -> None:
    """UsageError, in one line what to install, where it is not."""
    if not available():
        raise UsageError("--scheduler: wants Dask's distributed, not installed here: pip install 'station[cluster]'")


@contextmanager
def local_client(workers: int) -> Iterator[Client]:
    """A cluster of processes on this machine, one thread each; a worker that dies is replaced."""
    import dask
    from distributed import Client, LocalCluster

    for name, value in ONE_THREAD.items():
        os.environ.setdefault(name, value)
    with dask.config.set({"distributed.scheduler.allowed-failures": RETRIES}), LocalCluster(
            n_workers=workers, threads_per_worker=1, processes=True, host=LOCAL, dashboard_address=f"{LOCAL}:0",
            worker_dashboard_address=f"{LOCAL}:0", memory_limit=0, silence_logs=logging.CRITICAL) as cluster, \
            Client(cluster) as client:
        yield client


@contextmanager
def remote_client(scheduler: Scheduler) -> Iterator[Client]:
    """A connection to a scheduler that somebody runs; WorkError where nobody answers."""
    need()
    from distributed import Client
    from distributed.security import Security

    security = None
    if scheduler.ca is not None:
        security = Security(tls_ca_file=str(scheduler.ca), tls_client_cert=str(scheduler.cert),
                            tls_client_key=str(scheduler.key), require_encryption=True)
    logging.getLogger("distributed").setLevel(logging.CRITICAL)
    try:
        client = Client(scheduler.address, security=security, timeout=PATIENCE, set_as_default=False)
    except (OSError, TimeoutError) as error:
        raise WorkError(f"{scheduler.address}: no scheduler answers ({_first_line(error)})") from None
    with client:
        yield client


def over_cluster(work: Work, tasks: Iterable[Task], client: Client) -> Iterator[tuple[Task, dict[str, Any]]]:
    """Give each task with its answer as they end; a lost worker costs only its task, which is begun again elsewhere.

    No more tasks are handed out than there are threads, so that they are done in their order.
    """
    from distributed import as_completed

    source, run = iter(tasks), uuid.uuid4().hex
    pending: dict[Any, Any] = {}
    done = as_completed(loop=client.loop, with_results=True, raise_errors=False)

    def hand_out() -> None:
        room = max(sum(client.nthreads().values()), 1) - len(pending)
        for task in islice(source, max(room, 0)):
            future = client.submit(work, task, key=f"{task.label}-{run}", pure=False)
            pending[future.key] = (task, future)
            done.add(future)

    hand_out()
    for future, answer in done:
        task, _ = pending.pop(future.key)
        if future.status == "error":
            answer = {"failure": _killed(future.exception())}
        elif future.status != "finished":
            raise WorkError("the scheduler was lost; what is done is kept, the same command goes on from there")
        future.release()    # or the answer stays with its worker, and would be worked out again if that is lost
        hand_out()
        yield task, answer


def _killed(error: BaseException) -> str:
    from distributed import KilledWorker

    if isinstance(error, KilledWorker):
        return lost_line(RETRIES + 1)
    return f"{type(error).__name__}: {_first_line(error)}"


def _first_line(error: BaseException) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0]
