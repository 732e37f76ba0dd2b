"""An executor of parallel processes, each of which may die without stopping the others.

`concurrent.futures.ProcessPoolExecutor` stops all its processes when one of them dies, and accepts no further calls.
Here only the call of the dead process fails, and the next call gets a new process. Processes are spawned: neither
OpenGL nor JAX survives a fork.
"""

import multiprocessing
import os
import signal
import sys
import threading
from collections.abc import Callable
from concurrent.futures import BrokenExecutor, Executor, Future, ThreadPoolExecutor
from multiprocessing.connection import Connection
from multiprocessing.context import SpawnProcess
from queue import LifoQueue
from types import TracebackType
from typing import Any, TypeVar

from .argument_checks import as_integer

T = TypeVar("T")
NO_ANSWER_HINT = (
    "; if no process ever answers: a script must create WorkerProcesses under 'if __name__ == \"__main__\":'"
)
"""What usually is wrong where a new process dies before its first answer."""
SPAWN = multiprocessing.get_context("spawn")


def usable_cores() -> int:
    """Return the number of cores that this process may run on."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


class WorkerProcesses(Executor):
    """An executor of processes; leaving its `with` waits for the calls, and by an exception stops them at once.

    Functions, arguments and results are pickled. As with every spawned process, a script must create it under
    `if __name__ == "__main__":`. The call whose process dies raises `BrokenExecutor`; it may be submitted again.

    Args:
        count: largest number of processes; None for one on each usable core.

    Raises:
        OptionError: count is no integer of at least 1.
    """

    def __init__(self, count: int | None = None) -> None:
        count = usable_cores() if count is None else as_integer(count, "jobs", at_least=1)
        self._workers = [_Worker() for _ in range(count)]
        self._idle: LifoQueue[_Worker] = LifoQueue()
        for worker in self._workers:
            self._idle.put(worker)
        self._threads = ThreadPoolExecutor(count, thread_name_prefix="worker-process")

    def submit(self, fn: Callable[..., T], /, *args: Any, **kwargs: Any) -> Future[T]:
        """Schedule a call and return its future."""
        return self._threads.submit(self._call, fn, args, kwargs)

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """Accept no further calls; with `wait`, return when all calls are done and the processes have ended."""
        self._threads.shutdown(wait=wait, cancel_futures=cancel_futures)
        if wait:
            for worker in self._workers:
                worker.end()

    def stop(self) -> None:
        """End the processes now; a running call cleans up as after any exception."""
        self._threads.shutdown(wait=False, cancel_futures=True)
        for worker in self._workers:
            worker.terminate()
        self.shutdown()

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        if error is None:
            self.shutdown()
        else:
            self.stop()

    def _call(self, fn: Callable[..., T], args: tuple[Any, ...], kwargs: dict[str, Any]) -> T:
        worker = self._idle.get()
        try:
            return worker.call(fn, args, kwargs)
        finally:
            self._idle.put(worker)


class _Worker:
    """One process at a time, started when it is first needed, and again after it died."""

    def __init__(self) -> None:
        self._running: tuple[SpawnProcess, Connection] | None = None
        self._stopped, self._answered = False, False
        self._lock = threading.Lock()

    def call(self, fn: Callable[..., T], args: tuple[Any, ...], kwargs: dict[str, Any]) -> T:
        """Execute a call in the process and return its value.

        Raises:
            BrokenExecutor: the process died, or the worker was stopped.
        """
        process, connection = self._started()
        try:
            connection.send((fn, args, kwargs))
            returned, value = connection.recv()
        except (EOFError, OSError) as death:
            self.end()
            why = f"a worker process died (exit code {process.exitcode})"
            raise BrokenExecutor(why if self._answered else f"{why}{NO_ANSWER_HINT}") from death
        self._answered = True
        if returned:
            return value
        raise value

    def terminate(self) -> None:
        """End the process, and start no other."""
        with self._lock:
            self._stopped = True
            if self._running is not None:
                self._running[0].terminate()

    def end(self) -> None:
        """Close the pipe, which ends the process, and wait for it."""
        with self._lock:
            if self._running is not None:
                process, connection = self._running
                connection.close()
                process.join()
                self._running = None

    def _started(self) -> tuple[SpawnProcess, Connection]:
        with self._lock:
            if self._stopped:
                raise BrokenExecutor("the worker processes have been stopped")
            if self._running is None:
                connection, of_process = SPAWN.Pipe()
                process = SPAWN.Process(target=_serve, args=(of_process,), daemon=True)
                process.start()
                of_process.close()
                self._running = process, connection
            return self._running


def _serve(connection: Connection) -> None:
    """Execute calls until the pipe is closed; SIGTERM ends one as `sys.exit` does; the parent handles Ctrl-C."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    while True:
        try:
            fn, args, kwargs = connection.recv()
        except EOFError:
            return
        signal.signal(signal.SIGTERM, lambda *_: sys.exit())
        try:
            answer = (True, fn(*args, **kwargs))
        except Exception as failure:
            answer = (False, failure)
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
        connection.send(answer)
