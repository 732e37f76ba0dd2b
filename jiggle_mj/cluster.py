"""Other machines as an executor: a Dask scheduler and its workers, started by whoever owns them.

Dask is the optional extra `cluster`. The workers need this package, of the same version, and the same folders.
"""

import logging
import re
from collections.abc import Iterator
from concurrent.futures import Executor
from contextlib import contextmanager

from .errors import ClusterError, OptionError

URL = r"dask://(\[[0-9a-fA-F:]+\]|[^\s:/\[\]]+):(\d{1,5})"
PATIENCE = "10s"
"""How long the scheduler may take to answer."""
WORKERS_WITHIN = 30
"""Seconds after which there must be a worker."""


@contextmanager
def cluster(url: str) -> Iterator[Executor]:
    """Connect to a scheduler; leaving the `with` by an exception cancels what is under way there.

    Args:
        url: dask://HOST:PORT.

    Raises:
        OptionError: the URL is none of these.
        ClusterError: Dask is not installed, no scheduler answers, or it has no workers.
    """
    place = re.fullmatch(URL, url)
    if place is None or int(place[2]) > 65535:
        raise OptionError(f"executor = {url!r}: must be dask://HOST:PORT, as in dask://10.0.0.5:8786.")
    try:
        from distributed import Client  # pyright: ignore[reportMissingImports]  # an extra
    except ImportError as failure:
        raise ClusterError(
            f"{url} needs Dask, which is not installed ({failure}): pip install 'jiggle-mj[cluster]'."
        ) from failure
    try:
        client = Client(f"tcp://{place[1]}:{place[2]}", timeout=PATIENCE, set_as_default=False)
    except (OSError, ValueError) as failure:
        raise ClusterError(
            f"no Dask scheduler answers at {url} ({failure}). Start one with 'dask scheduler', and workers with "
            "'dask worker HOST:PORT --nworkers auto --nthreads 1'."
        ) from failure
    with client:
        logging.getLogger("distributed.client").setLevel(logging.CRITICAL)  # each lost call is reported by its seed
        try:
            client.wait_for_workers(1, timeout=WORKERS_WITHIN)
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
    """Whether Dask gave a call up because worker after worker died at it; known by name, as Dask may not be there."""
    return type(failure).__name__ == "KilledWorker"
