# The wheel of Pinocchio lies in a directory that only a start-up hook adds to the path, and holds compiled modules
# without stubs: to the type checker every name of it is Any.
from typing import Any

def __getattr__(name: str) -> Any: ...
