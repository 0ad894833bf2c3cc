"""Small pieces of HTML and SVG by which objects show themselves in a notebook or on a page; all text is escaped."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from html import escape
from itertools import pairwise

import numpy as np

WIDTH, HEIGHT = 560, 120
POINTS = 400
"""Most points of a line; of more rows the least and greatest of each stretch are drawn."""
STYLES = ("#8a8a8a", "#0b62a4", "#c2410c", "#4d7c0f")


def table(header: Sequence[object], rows: Iterable[Sequence[object]], caption: str = "") -> str:
    """A table; cells are text."""
    head = "".join(f"<th>{escape(str(cell))}</th>" for cell in header)
    body = "".join("<tr>" + "".join(f"<td>{escape(str(cell))}</td>" for cell in row) + "</tr>" for row in rows)
    above = f"<caption>{escape(caption)}</caption>" if caption else ""
    return f"<table>{above}<thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"


def plot(t: np.ndarray, lines: Mapping[str, np.ndarray], label: str, width: int = WIDTH, height: int = HEIGHT,
         ranges: bool = True) -> str:
    """Lines (n) over time t (n), s, as an SVG that says in words what it shows; ``ranges``: label and ranges below."""
    values = np.concatenate([np.asarray(line, dtype=float) for line in lines.values()])
    values = values[np.isfinite(values)]
    low, high = (float(values.min()), float(values.max())) if values.size else (0.0, 1.0)
    high = high if high > low else low + 1.0
    span = float(t[-1] - t[0]) or 1.0
    drawn = []
    for (name, line), colour in zip(lines.items(), STYLES, strict=False):
        rows = _thinned(np.asarray(line, dtype=float))
        x = (t[rows] - t[0]) / span * width
        y = (high - line[rows]) / (high - low) * (height - 4) + 2
        points = " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(x, y, strict=True) if np.isfinite(b))
        drawn.append(f'<polyline fill="none" stroke="{colour}" stroke-width="1.3" points="{points}">'
                     f"<title>{escape(name)}</title></polyline>")
    words = escape(f"{label}: {', '.join(lines)}; {low:.4g} to {high:.4g}, {t[0]:.3g} to {t[-1]:.3g} s", quote=True)
    below = ""
    if ranges:
        below = (f'<text x="0" y="{height + 14}" font-size="12" font-family="sans-serif" fill="#777">{escape(label)}: '
                 f"{low:.4g} to {high:.4g}, {t[0]:.3g} to {t[-1]:.3g} s</text>")
        height += 20
    return (f'<svg role="img" aria-label="{words}" viewBox="0 0 {width} {height}" width="{width}" height="{height}" '
            f'xmlns="http://www.w3.org/2000/svg"><title>{words}</title>{"".join(drawn)}{below}</svg>')


def legend(names: Iterable[str]) -> str:
    """The lines' names in their colours."""
    return " ".join(f'<span style="color:{colour}">&#9644; {escape(name)}</span>'
                    for name, colour in zip(names, STYLES, strict=False))


def _thinned(line: np.ndarray) -> np.ndarray:
    """Rows that hold the least and the greatest value of each stretch, in order."""
    if len(line) <= POINTS:
        return np.arange(len(line))
    edges = np.linspace(0, len(line), POINTS // 2 + 1).astype(int)
    found = {0, len(line) - 1}
    for first, last in pairwise(edges):
        stretch = np.nan_to_num(line[first:last])
        found |= {first + int(stretch.argmin()), first + int(stretch.argmax())}
    return np.array(sorted(found))
