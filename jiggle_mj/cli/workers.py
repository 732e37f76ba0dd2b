"""The processes of `--jobs` and the cluster of `--executor`, of which one is given."""

from concurrent.futures import Executor
from contextlib import AbstractContextManager

from ..errors import OptionError


def workers(jobs: int | None, executor: str | None) -> AbstractContextManager[Executor]:
    """Return the executor that the options name; leaving its `with` ends it.

    Args:
        jobs: number of processes on this machine; one for each usable core if None.
        executor: URL of a Dask scheduler instead.

    Raises:
        OptionError: both are given, or one of them cannot be used.
        ClusterError: the cluster cannot be used.
    """
    from ..cluster import cluster
    from ..worker_processes import WorkerProcesses

    if jobs is not None and executor is not None:
        raise OptionError("--jobs is for this machine, --executor for other machines: give one of them.")
    return WorkerProcesses(jobs) if executor is None else cluster(executor)
