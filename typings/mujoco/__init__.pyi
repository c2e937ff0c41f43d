# MuJoCo's bindings are compiled and come without stubs: every name of them is unknown
# to the type checker instead of an error.
from typing import Any

def __getattr__(name: str) -> Any: ...
