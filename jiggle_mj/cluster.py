"""A Dask cluster as an executor; its owner starts the scheduler and the workers.

Dask is the optional extra `cluster`. The workers need the same version of this package, and the same folders.
"""

import logging
import re
from collections.abc import Iterator
from concurrent.futures import Executor
from contextlib import contextmanager

from .argument_checks import as_instance, as_number
from .errors import ClusterError, OptionError

URL = r"dask://(\[[0-9a-fA-F:]+\]|[^\s:/\[\]]+):(\d{1,5})"
"""Pattern of a scheduler's URL: its host and its port."""
MAX_PORT = 65535
"""Largest TCP port."""
CONNECT_TIMEOUT_S = 10.0
"""Default time for the scheduler to answer [s], so that a wrong address is reported soon."""
WORKER_TIMEOUT_S = 30.0
"""Default time for the first worker to join [s]: workers that are just being started have time to."""


@contextmanager
def cluster(
    url: str, *, connect_timeout_s: float = CONNECT_TIMEOUT_S, worker_timeout_s: float = WORKER_TIMEOUT_S
) -> Iterator[Executor]:
    """Connect to a scheduler and yield an executor; leaving the `with` cancels the calls that have not finished.

    Args:
        url: dask://HOST:PORT.
        connect_timeout_s: how long the scheduler may take to answer [s].
        worker_timeout_s: how long the first worker may take to join [s].

    Raises:
        OptionError: the URL has another form, or a time is not above 0.
        ClusterError: Dask is not installed, no scheduler answers, or it has no workers.
    """
    as_instance(url, "executor", str, hint="It is dask://HOST:PORT.")
    connect_timeout_s = as_number(connect_timeout_s, "connect_timeout_s", unit="s", above=0)
    worker_timeout_s = as_number(worker_timeout_s, "worker_timeout_s", unit="s", above=0)
    address = re.fullmatch(URL, url)
    if address is None or int(address[2]) > MAX_PORT:
        raise OptionError(f"executor = {url!r}: must be dask://HOST:PORT, as in dask://10.0.0.5:8786.")
    try:
        from distributed import Client  # pyright: ignore[reportMissingImports]  # an extra
    except ImportError as failure:
        raise ClusterError(
            f"{url} needs Dask, which is not installed ({failure}): pip install 'jiggle-mj[cluster]'."
        ) from failure
    try:
        client = Client(f"tcp://{address[1]}:{address[2]}", timeout=connect_timeout_s, set_as_default=False)
    except (OSError, ValueError) as failure:
        raise ClusterError(
            f"no Dask scheduler answers at {url} ({failure}). Start one with 'dask scheduler', and workers with "
            "'dask worker HOST:PORT --nworkers auto --nthreads 1'."
        ) from failure
    with client:
        logging.getLogger("distributed.client").setLevel(logging.CRITICAL)  # each lost call is reported by its seed
        try:
            client.wait_for_workers(1, timeout=worker_timeout_s)
        except TimeoutError as failure:
            raise ClusterError(
                f"the scheduler at {url} has no workers. Start some with 'dask worker HOST:PORT --nworkers auto "
                "--nthreads 1', then repeat the command."
            ) from failure
        executor = client.get_executor(pure=False)
        try:
            yield executor
        finally:
            executor.shutdown(wait=False)


def died_with_its_worker(failure: BaseException) -> bool:
    """Return whether Dask gave up a call after several workers died at it; by name, as Dask need not be installed."""
    return type(failure).__name__ == "KilledWorker"
