"""mujoco's names come from compiled modules without stubs: to a type checker each of them is anything."""

from typing import Any

def __getattr__(name: str) -> Any: ...
