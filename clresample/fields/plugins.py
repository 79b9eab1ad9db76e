"""Formats by name: our own, and those that other packages add by entry points."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from importlib.metadata import EntryPoint, entry_points


class Formats(Mapping):
    """Readers by the names that scene and field files have for them.

    Another package adds one in its pyproject.toml, for example

        [project.entry-points."clresample.readers"]
        my-survey = "my_package.clresample:read_my_survey"

    and it is imported when a file uses the format. Built-in names cannot be replaced.

    group: of the entry points; own {name: function}
    """

    def __init__(self, group: str, own: Mapping[str, Callable]):
        self.group, self.own = group, dict(own)

    def __iter__(self) -> Iterator[str]:
        yield from self.own
        added = {point.name for point in entry_points(group=self.group)}
        yield from sorted(added - set(self.own))

    def __len__(self):
        return len(list(iter(self)))

    def __contains__(self, name):
        return name in self.own or (isinstance(name, str) and bool(self._points(name)))

    def __getitem__(self, name) -> Callable:
        """The reader of a name.

        Raises KeyError for an unknown one, ValueError for one that cannot be imported or that
        several packages add.
        """
        if name in self.own:
            return self.own[name]
        points = self._points(name)
        if not points:
            raise KeyError(name)
        if len({point.value for point in points}) > 1:
            packages = " and ".join(sorted(map(_package, points)))
            raise ValueError(f"format {name!r} is added by {packages}: uninstall one of them")
        try:
            return points[0].load()
        except Exception as error:  # whatever a module of others raises while it is imported
            raise ValueError(
                f"format {name!r} of {_package(points[0])} cannot be imported: "
                f"{type(error).__name__}: {error}"
            ) from error

    def _points(self, name) -> list[EntryPoint]:
        """The entry points of a name."""
        return list(entry_points(group=self.group, name=name))


def _package(point):
    """The package of an entry point with its version, as far as they are known."""
    return "an unknown package" if point.dist is None else f"{point.dist.name} {point.dist.version}"
