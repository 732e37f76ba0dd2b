"""What a compiled program calls."""

import re
from collections.abc import Callable
from typing import Any

import jax


def batched_lapack_calls(function: Callable[..., Any], *arguments: Any) -> list[str]:
    """Return the calls of LAPACK, in a function compiled for these arguments, that take more than one matrix."""
    program = jax.jit(function).lower(*arguments).compile().as_text()
    calls = [line.strip() for line in (program or "").splitlines() if 'custom_call_target="lapack' in line]
    return [
        line for line in calls if any(dimensions.count(",") > 1 for dimensions in re.findall(r"f64\[([\d,]+)\]", line))
    ]
