"""Small charts as SVG text: points or lines over two axes, drawn in a millisecond, with the values in tooltips."""

from __future__ import annotations

import math
from collections.abc import Sequence
from html import escape
from typing import NamedTuple

WIDTH, HEIGHT = 620, 300
LEFT, RIGHT, TOP, BOTTOM = 52, 16, 28, 44
COLOURS = ("#1b6ca8", "#d1603d", "#3d8b5f", "#8a5aa6", "#b08d00", "#5c6b73", "#c2457d", "#2a9d9d")


class Point(NamedTuple):
    """One value and what its tooltip says."""

    x: float
    y: float
    label: str = ""


class Series(NamedTuple):
    """Points of one colour; the name stands in the legend unless it is empty."""

    name: str
    points: Sequence[Point]


def chart(series: Sequence[Series], x_label: str, y_label: str, lines: bool = False, log_x: bool = False) -> str | None:
    """An <svg> of the finite points (positive x where `log_x`), or None where there are none."""

    def at(x: float) -> float:
        return math.log10(x) if log_x else x

    kept = [
        Series(s.name, [p for p in s.points if math.isfinite(p.x) and math.isfinite(p.y) and (p.x > 0 or not log_x)])
        for s in series
    ]
    every = [p for s in kept for p in s.points]
    if not every:
        return None
    x_ticks = log_ticks(*_span(p.x for p in every)) if log_x else ticks(*_span(p.x for p in every))
    y_ticks = ticks(*_span(p.y for p in every))
    x0, x1 = at(min(x_ticks[0], *(p.x for p in every))), at(max(x_ticks[-1], *(p.x for p in every)))
    y0, y1 = min(y_ticks[0], *(p.y for p in every)), max(y_ticks[-1], *(p.y for p in every))

    def px(x: float) -> float:
        return LEFT + (at(x) - x0) / ((x1 - x0) or 1) * (WIDTH - LEFT - RIGHT)

    def py(y: float) -> float:
        return HEIGHT - BOTTOM - (y - y0) / ((y1 - y0) or 1) * (HEIGHT - TOP - BOTTOM)

    out = [f'<svg viewBox="0 0 {WIDTH} {HEIGHT}" width="{WIDTH}" role="img" aria-label="{escape(y_label)}">']
    for x in x_ticks:
        out.append(f'<path d="M{px(x):.1f} {TOP}V{HEIGHT - BOTTOM}" stroke="#e6e6e6"/>')
        out.append(_text(px(x), HEIGHT - BOTTOM + 16, _number(x), "middle"))
    for y in y_ticks:
        out.append(f'<path d="M{LEFT} {py(y):.1f}H{WIDTH - RIGHT}" stroke="#e6e6e6"/>')
        out.append(_text(LEFT - 6, py(y) + 4, _number(y), "end"))
    out.append(_text((LEFT + WIDTH - RIGHT) / 2, HEIGHT - 8, x_label, "middle"))
    middle = (TOP + HEIGHT - BOTTOM) / 2
    out.append(_text(14, middle, y_label, "middle", f' transform="rotate(-90 14 {middle})"'))
    for i, (_, points) in enumerate(kept):
        colour = COLOURS[i % len(COLOURS)]
        if lines:
            path = " ".join(f"{px(p.x):.1f},{py(p.y):.1f}" for p in points)
            out.append(f'<polyline points="{path}" fill="none" stroke="{colour}" stroke-width="1.5"/>')
            continue
        for p in points:
            circle = f'<circle cx="{px(p.x):.1f}" cy="{py(p.y):.1f}" r="4.5" fill="{colour}" fill-opacity=".75">'
            out.append(f"{circle}<title>{escape(p.label)}</title></circle>")
    x = float(LEFT)
    for i, (name, points) in enumerate(kept):
        if name and points:
            out.append(f'<circle cx="{x + 5:.1f}" cy="12" r="4.5" fill="{COLOURS[i % len(COLOURS)]}"/>')
            out.append(_text(x + 14, 16, name, "start"))
            x += 30 + 7 * len(name)
    return "".join(out) + "</svg>"


def ticks(low: float, high: float, count: int = 6) -> list[float]:
    """Round numbers with even steps (1, 2 or 5 times a power of ten) from at most `low` to at least `high`."""
    step = (high - low) / max(1, count - 1) or abs(high) or 1.0
    power = 10.0 ** math.floor(math.log10(step))
    step = next(m * power for m in (1, 2, 5, 10) if m * power >= step * (1 - 1e-9))
    first, last = math.floor(low / step + 1e-9), math.ceil(high / step - 1e-9)
    return [i * step for i in range(first, last + 1)]


def log_ticks(low: float, high: float) -> list[float]:
    """1, 2 and 5 times powers of ten from at most `low` to at least `high` (both positive)."""
    powers = range(math.floor(math.log10(low)) - 1, math.ceil(math.log10(high)) + 2)
    every = [m * 10.0**p for p in powers for m in (1, 2, 5)]
    first = max(i for i, v in enumerate(every) if v <= low * (1 + 1e-9))
    last = min(i for i, v in enumerate(every) if v >= high * (1 - 1e-9))
    return every[first : last + 1]


def _span(values) -> tuple[float, float]:  # type: ignore[no-untyped-def]
    values = list(values)
    return min(values), max(values)


def _number(value: float) -> str:
    return f"{value:.6g}"


def _text(x: float, y: float, text: str, anchor: str, more: str = "") -> str:
    return (
        f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}" font-size="12" fill="#444"{more}>{escape(text)}</text>'
    )
