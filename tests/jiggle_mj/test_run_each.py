"""Results of calls on an executor, by their keys."""

from jiggle_mj.run_each import run_each
from tests.support.series import Inside


def inverse(value: float) -> float:
    return 1 / value


def test_each_result_has_its_key_and_a_failure_has_none():
    results, ended = dict[str, float](), list[tuple[str, str | None]]()
    failed = run_each(
        inverse,
        {"a": 2.0, "b": 0.0, "c": 4.0},
        Inside(),
        on_done=lambda key, why: ended.append((key, why)),
        fails_alone=lambda failure: isinstance(failure, ZeroDivisionError),
        on_result=results.__setitem__,
    )
    assert results == {"a": 0.5, "c": 0.25}
    assert [key for key, _ in ended] == ["a", "b", "c"] and list(failed) == ["b"]
