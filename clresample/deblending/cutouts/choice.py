"""Resolves numbers and names of a result's sources and observations."""

from __future__ import annotations

import numbers

import numpy as np


class MissingSource(ValueError):
    """A source without a model, or without data in an observation."""


def chosen_sources(result, source) -> tuple[int, ...]:
    """Numbers of the sources selected by a number, a name, or a sequence of these.

    A number outside the sources' range is looked up among their names, as fields name their sources
    by numbers.
    Raises ValueError for an unknown source and for an empty sequence.
    """
    one = isinstance(source, (str, numbers.Integral)) or np.ndim(source) == 0
    wanted = [source] if one else list(source)
    if not wanted:
        raise ValueError("source is empty, must name one source or more")
    names = [s.name for s in result.sources]
    found = []
    for each in wanted:
        known = isinstance(each, (numbers.Integral, np.integer)) and not isinstance(each, bool)
        if known and 0 <= each < len(names):
            found.append(int(each))
        elif (known or isinstance(each, str)) and str(each) in names:
            found.append(names.index(str(each)))
        else:
            raise ValueError(
                f"source is {each!r}, must be a number from 0 to {len(names) - 1}"
                + (" or a source's name" if any(names) else "")
            )
    return tuple(dict.fromkeys(found))


def chosen_observation(observations, observation) -> tuple[int, int | None]:
    """Number of an observation, and of one channel of it, or None for all channels.

    observation: a number, an observation's name, or a channel's
    Raises ValueError if it selects no observation, or several.
    """
    if isinstance(observation, numbers.Integral) and not isinstance(observation, bool):
        if 0 <= int(observation) < len(observations):
            return int(observation), None
    elif isinstance(observation, str):
        named = [i for i, o in enumerate(observations) if observation == o.name]
        if len(named) == 1:
            return named[0], None
        for i, o in enumerate(observations):
            if observation in o.channels and not named:
                return i, o.channels.index(observation)
    names = [repr(o.name) for o in observations if o.name]
    names += [repr(c) for o in observations for c in o.channels]
    raise ValueError(
        f"observation is {observation!r}, must be a number from 0 to {len(observations) - 1}, the "
        f"name of one observation, or a channel: {', '.join(names)}"
    )
