"""Names that files can hold: in FITS cards, and as parts of FITS columns' names."""

from __future__ import annotations

from itertools import pairwise

# Characters of a column's name, or of a text on one card, that FITS takes; an apostrophe is written
# as two.
COLUMN = 68
MAX_CHARACTERS = COLUMN - len("group_flux_err_")  # of channels, whose longest column that is


def to_ascii(text):
    """Text as FITS cards can hold it: "?" for other characters than printable ASCII."""
    return "".join(c if " " <= c <= "~" else "?" for c in str(text))


def text_card(text, comment):
    """(value, comment) of a FITS card: the text in ASCII, the comment if there is room for it.

    Text longer than a card continues in further cards.
    """
    value, comment = to_ascii(text), to_ascii(comment)
    length = max(len(value) + value.count("'"), 8)  # shorter ones are padded
    has_room = length > COLUMN or length + len(" / ") + len(comment) <= COLUMN
    return value, comment if has_room else ""


def check_columns(names):
    """Raises ValueError for column names of a catalogue that do not fit into FITS cards."""
    for name in names:
        n = len(name) + name.count("'")
        if n > COLUMN:
            raise ValueError(
                f"column {name[:20]!r}... of the catalogue has {n} characters, FITS takes "
                f"{COLUMN}: give observations and channels shorter names"
            )


def check_catalogue_names(observations, *, magnitudes=False):
    """Raises ValueError where names of observations make columns that FITS cannot hold.

    The columns are those of a catalogue, named after observations and channels; magnitudes: see
    `catalogue`.
    """
    bands = list(dict.fromkeys(band for o in observations for band in o.bands))
    check_channels([channel for o in observations for channel in o.channels])
    check_channels(bands)
    check_columns(f"chi2_{o.name}" for o in observations)
    if magnitudes:
        check_columns(f"colour_err_{a}_{b}" for a, b in pairwise(bands))


def check_channels(channels):
    """Raises ValueError if the channels' names cannot be FITS columns.

    Too long, or the same once characters that FITS does not have are replaced.
    """
    seen = {}
    for channel in channels:
        n = len(channel) + channel.count("'")
        if n > MAX_CHARACTERS:
            raise ValueError(
                f"channel name {channel[:20]!r}... has {n} characters, columns of the "
                f"catalogue take {MAX_CHARACTERS}: give shorter names with channels = [...]"
            )
        plain = to_ascii(channel).lower()
        if plain in seen and channel != seen[plain]:
            raise ValueError(
                f"channel names {seen[plain]!r} and {channel!r} are one in FITS, which knows "
                "printable ASCII and no difference of case: rename one with channels = [...]"
            )
        seen[plain] = channel
