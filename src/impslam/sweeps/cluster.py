"""Workers of a Dask cluster, on any number of machines: the extra `distributed`.

The scheduler reassigns the work of a worker that dies; after three workers have died with the same work, it
gives up (`distributed.scheduler.allowed-failures`).
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from itertools import islice
from typing import Any, TypeVar

from impslam.errors import ConfigError, ImpError
from impslam.extras import install
from impslam.sweeps.pool import Pool, ProcessDied

T = TypeVar("T")
R = TypeVar("R")
CONNECT_TIMEOUT = 10.0
"""s to wait for a scheduler, and then for a first worker."""


@dataclass(frozen=True, slots=True)
class Cluster(Pool):
    """The workers of the scheduler at an address, e.g. tcp://192.168.1.2:8786."""

    address: str

    def each(
        self, work: Callable[[T], R], items: Iterable[T]
    ) -> Iterator[tuple[int, R | ProcessDied]]:
        """Yield results; see `Pool.each`.

        Raises
        ------
        ConfigError
            If there is no scheduler, or it has no worker.
        ImpError
            If the scheduler stops during the work.
        """
        with self._client() as client:
            from distributed import as_completed  # noqa: PLC0415  # an extra

            todo, index, in_progress = enumerate(items), {}, as_completed()
            while True:
                free = max(1, sum(client.nthreads().values())) - in_progress.count()
                for number, item in islice(todo, max(0, free)):
                    future = client.submit(work, item, pure=False)
                    index[future.key] = number
                    in_progress.add(future)
                if not in_progress.count():
                    return
                future = next(in_progress)
                yield index.pop(future.key), self._result(future)
                future.release()

    def _result(self, future: Any) -> Any:
        from distributed import KilledWorker  # noqa: PLC0415  # an extra

        try:
            return future.result()
        except KilledWorker as error:
            return ProcessDied(
                f"its workers were killed: out of memory, or by the system ({error})"
            )
        except Exception as error:
            if "deserialization" in str(error):
                raise ImpError(
                    f"--scheduler {self.address}: a worker cannot run the jobs; install the same impslam "
                    "and Python on the workers"
                ) from error
            if future.status == "error":  # raised by the work
                raise
            raise ImpError(
                f"--scheduler {self.address}: the scheduler has stopped; start it and run again, finished "
                "runs are kept"
            ) from error

    def _client(self) -> Any:
        try:
            from distributed import Client  # noqa: PLC0415  # an extra
        except ImportError:
            raise ConfigError(
                f"--scheduler needs Dask; install it with `{install('distributed')}`"
            ) from None
        logging.getLogger("distributed").setLevel(logging.CRITICAL)  # it repeats our errors
        try:
            client = Client(self.address, timeout=CONNECT_TIMEOUT)
        except (OSError, TimeoutError, ValueError) as error:
            raise ConfigError(
                f"--scheduler {self.address}: no scheduler answers ({type(error).__name__}); start one "
                "with 'dask scheduler', which prints its address"
            ) from None
        try:
            client.wait_for_workers(1, timeout=CONNECT_TIMEOUT)
        except TimeoutError:
            client.close()
            raise ConfigError(
                f"--scheduler {self.address}: has no worker; start some with 'dask worker "
                f"{self.address} --nthreads 1'"
            ) from None
        return client
