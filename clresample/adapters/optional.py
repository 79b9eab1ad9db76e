"""Import a package that a bridge needs, or say how to install it."""

from __future__ import annotations

from importlib import import_module


def require(module, extra):
    """The module, imported. Raises ImportError that says what to install.

    module: its full name; extra: of clresample, which installs it
    """
    try:
        return import_module(module)
    except ImportError as error:
        package = module.partition(".")[0]
        raise ImportError(
            f"clresample.adapters.{extra} needs {package}, which cannot be imported ({error}): "
            f"pip install {package}"
        ) from error
