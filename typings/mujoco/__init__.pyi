# MuJoCo's names come from compiled modules without stubs: to the type checker every name of it is Any.
from typing import Any

def __getattr__(name: str) -> Any: ...
