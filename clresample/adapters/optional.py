"""Imports the optional packages of the bridges, or names the extra to install."""

from __future__ import annotations

from importlib import import_module


def require(module, extra):
    """Imports a module. Raises ImportError that names the package to install.

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
