"""A Dask scheduler and its workers on this machine."""

import json
import subprocess
import sys
from contextlib import contextmanager
from pathlib import Path

from tests.support.series import until


@contextmanager
def dask_cluster(folder: Path, n_workers: int):
    """Start a scheduler and workers without nannies, each a process on loopback; yield the URL and the workers."""
    address = folder / "scheduler.json"
    started, log = [], (folder / "dask.log").open("w")

    def start(*words):
        command = [sys.executable, "-m", "distributed.cli." + words[0], *words[1:]]
        started.append(subprocess.Popen(command, stdout=log, stderr=log, cwd=folder))

    try:
        start(
            "dask_scheduler", "--host", "127.0.0.1", "--port", "0", "--no-dashboard", "--scheduler-file", str(address)
        )
        until(lambda: address.exists() and address.read_text().endswith("}"))
        for _ in range(n_workers):
            start("dask_worker", "--scheduler-file", str(address), "--no-nanny", "--nthreads", "1", "--no-dashboard")
        yield json.loads(address.read_text())["address"].replace("tcp://", "dask://"), started[1:]
    finally:
        for process in started:
            process.kill()
            process.wait()
        log.close()
