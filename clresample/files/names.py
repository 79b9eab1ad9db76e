"""Names that files can hold: in FITS cards, and as parts of FITS columns' names."""

from __future__ import annotations

# A FITS card holds a column's name of 68 characters; the longest prefix is "flux_err_".
MOST_CHARACTERS = 68 - len("flux_err_")


def to_ascii(text):
    """Text as FITS cards can hold it: "?" for other characters than printable ASCII."""
    return "".join(c if " " <= c <= "~" else "?" for c in str(text))


def check_channels(channels):
    """Raise ValueError where the names of all observations' channels can be no FITS columns.

    Too long, or the same once characters that FITS does not have are replaced.
    """
    seen = {}
    for channel in channels:
        if len(channel) > MOST_CHARACTERS:
            raise ValueError(
                f"channel name {channel[:20]!r}... has {len(channel)} characters, columns of the "
                f"catalogue take {MOST_CHARACTERS}: give shorter names with channels = [...]"
            )
        plain = to_ascii(channel).lower()
        if plain in seen and channel != seen[plain]:
            raise ValueError(
                f"channel names {seen[plain]!r} and {channel!r} are one in FITS, which knows "
                "printable ASCII and no difference of case: rename one with channels = [...]"
            )
        seen[plain] = channel
