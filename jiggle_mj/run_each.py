"""Calls on any `concurrent.futures.Executor`, each of which may fail or lose its worker while the others continue."""

from collections import Counter
from collections.abc import Callable, Hashable, Mapping
from concurrent.futures import BrokenExecutor, CancelledError, Executor, Future
from queue import SimpleQueue
from typing import Any, TypeVar

from .cluster import died_with_its_worker

Key = TypeVar("Key", bound=Hashable)
Argument = TypeVar("Argument")
TRIES = 3
"""How many workers may die at a call before it is given up."""
CANCELLED = "its executor cancelled it, because it was stopped or lost its scheduler"
"""Reason for a call that its executor cancelled."""


def run_each(
    function: Callable[[Argument], object],
    arguments: Mapping[Key, Argument],
    executor: Executor,
    *,
    on_done: Callable[[Key, str | None], None],
    fails_alone: Callable[[BaseException], bool],
    on_result: Callable[[Key, Any], None] = lambda key, result: None,
) -> dict[Key, str]:
    """Call a function for each argument, and return by key the reasons of the calls that failed.

    Args:
        function: what to call; it goes through pickle where the executor has other processes.
        arguments: argument of each call by key.
        executor: calls it; it is not shut down. A call whose worker died is submitted again.
        on_done: called with the key of each call that ended, and the reason if it failed.
        fails_alone: says whether a failure is of its own call; any other ends all.
        on_result: called with the key of each call that succeeded, and what it returned, before `on_done`.

    Raises:
        Exception: the first failure that is not of its call alone. Calls that have not begun are cancelled then, and by
            Ctrl-C.
    """
    finished: SimpleQueue[Future[object]] = SimpleQueue()
    pending: dict[Future[object], Key] = {}
    deaths: Counter[Key] = Counter()
    failed: dict[Key, str] = {}

    def submit(key: Key) -> None:
        try:
            future = executor.submit(function, arguments[key])
        except BrokenExecutor as failure:
            future = Future()
            future.set_exception(failure)
        pending[future] = key
        future.add_done_callback(finished.put)

    def fail(key: Key, why: str) -> None:
        failed[key] = why
        on_done(key, why)

    try:
        for key in arguments:
            submit(key)
        while pending:
            future = finished.get()
            key = pending.pop(future)
            failure = CancelledError(CANCELLED) if future.cancelled() else future.exception()
            if failure is None:
                on_result(key, future.result())
                on_done(key, None)
            elif isinstance(failure, BrokenExecutor):
                deaths[key] += 1
                if deaths[key] < TRIES:
                    submit(key)
                else:
                    fail(key, f"its worker died or could not be started {TRIES} times: {failure}.")
            elif isinstance(failure, CancelledError) or died_with_its_worker(failure) or fails_alone(failure):
                fail(key, str(failure))
            else:
                raise failure
    finally:
        for future in pending:
            future.cancel()
    return failed
