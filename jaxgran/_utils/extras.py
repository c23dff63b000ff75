"""Imports of packages that only the extras of jaxgran install."""

from importlib import import_module
from typing import Any


def import_extra(name: str, extra: str = "notebook") -> Any:
    """Import a module that an extra of jaxgran installs.

    Raises:
        ModuleNotFoundError: if it is not installed, naming the extra.
    """
    try:
        return import_module(name)
    except ModuleNotFoundError as error:
        package = name.partition(".")[0]
        if error.name != package:
            raise
        raise ModuleNotFoundError(
            f'this needs {package}: pip install "jaxgran[{extra}]"', name=package
        ) from None
