"""Notebook cards of objects: a table of their properties and their picture."""

from __future__ import annotations

import base64
import html

from .figure import png_of

TABLE = "border-collapse:collapse;margin:0.3em 0;font-size:90%"
CELL = "text-align:left;padding:0.15em 1em 0.15em 0;vertical-align:top"


def card(title, properties, draw=None):
    """HTML of an object, in the page's own colours, light or dark.

    title: heading; properties {name: text}; draw: makes its figure, omitted without matplotlib
    """
    rows = "".join(
        f'<tr><th style="{CELL};font-weight:normal;opacity:0.7">{html.escape(str(name))}</th>'
        f'<td style="{CELL}">{html.escape(str(text))}</td></tr>'
        for name, text in properties.items()
    )
    return (
        f"<div><strong>{html.escape(title)}</strong>"
        f'<table style="{TABLE}">{rows}</table>{_picture(draw)}</div>'
    )


def _picture(draw):
    """The figure as an image inside the HTML."""
    if draw is None:
        return ""
    try:
        data = base64.b64encode(png_of(draw())).decode()
    except ImportError:
        return ""
    return f'<img alt="" style="max-width:100%" src="data:image/png;base64,{data}">'


def format_values(values, form=".3g"):
    """A few values as text, the first six where there are more; numbers in the given format."""
    values = list(values)
    more = " ..." if len(values) > 6 else ""
    return " ".join(format(v, form) for v in values[:6]) + more
