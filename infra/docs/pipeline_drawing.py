"""Draws the pipeline as docs/figures/pipeline.svg: plain SVG, readable on a light and on a dark page."""

from __future__ import annotations

from html import escape
from pathlib import Path

#: (name, what it makes, column, row) of each stage.
BOXES = (
    ("photos", "3 to 9, or one", 0, 0),
    ("ingest", "upright sRGB", 1, 0),
    ("poses", "cameras", 2, 0),
    ("plan", "path, groups", 3, 0),
    ("sample", "80 to 960 views", 4, 0),
    ("decode", "generated views", 4, 1),
    ("encode", "latents", 3, 1),
    ("reconstruct", "one 3D scene", 2, 1),
    ("render", "views, depth, mesh", 1, 1),
    ("evaluate", "metrics, report", 0, 1),
)
ARROWS = ((0, 1), (1, 2), (2, 3), (3, 4), (4, 5), (2, 6), (6, 4), (5, 7), (2, 7), (7, 8), (8, 9))
WIDTH, HEIGHT, GAP_X, GAP_Y, MARGIN = 132, 54, 44, 78, 10
GENERATIVE = {"plan", "encode", "sample", "decode"}


def place(column: int, row: int) -> tuple[int, int]:
    """Left and top of a box."""
    return MARGIN + column * (WIDTH + GAP_X), MARGIN + row * (HEIGHT + GAP_Y)


def box(name: str, made: str, column: int, row: int) -> str:
    """A stage: its name and what it makes."""
    left, top = place(column, row)
    colour = "#b5651d" if name in GENERATIVE else "#00796b"
    return (
        f'<rect x="{left}" y="{top}" width="{WIDTH}" height="{HEIGHT}" rx="8" fill="{colour}"/>'
        f'<text x="{left + WIDTH // 2}" y="{top + 23}" class="name">{escape(name)}</text>'
        f'<text x="{left + WIDTH // 2}" y="{top + 41}" class="made">{escape(made)}</text>'
    )


def arrow(first: int, second: int) -> str:
    """A line from the edge of one box to the edge of another."""
    (_, _, c0, r0), (_, _, c1, r1) = BOXES[first], BOXES[second]
    (x0, y0), (x1, y1) = place(c0, r0), place(c1, r1)
    if r0 == r1:
        right = c1 > c0
        start = (x0 + (WIDTH if right else 0), y0 + HEIGHT // 2)
        end = (x1 + (0 if right else WIDTH), y1 + HEIGHT // 2)
    else:
        down = r1 > r0
        start = (x0 + WIDTH // 2, y0 + (HEIGHT if down else 0))
        end = (x1 + WIDTH // 2, y1 + (0 if down else HEIGHT))
    return f'<line x1="{start[0]}" y1="{start[1]}" x2="{end[0]}" y2="{end[1]}" class="arrow" marker-end="url(#head)"/>'


def drawing() -> str:
    """The whole picture."""
    right, bottom = place(4, 1)
    width, height = right + WIDTH + MARGIN, bottom + HEIGHT + MARGIN
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" role="img">',
        "<title>Photos become cameras, a plan, generated views, one 3D scene, renders and metrics</title>",
        "<style>text{font-family:sans-serif;text-anchor:middle;fill:#fff}.name{font-size:15px;font-weight:bold}"
        ".made{font-size:12px}.arrow{stroke:#888;stroke-width:2}</style>",
        '<marker id="head" viewBox="0 0 8 8" refX="7" refY="4" markerWidth="7" markerHeight="7" orient="auto">'
        '<path d="M0 0L8 4L0 8z" fill="#888"/></marker>',
        *(arrow(*pair) for pair in ARROWS),
        *(box(*one) for one in BOXES),
        "</svg>",
    ]
    return "\n".join(parts) + "\n"


if __name__ == "__main__":
    target = Path(__file__).resolve().parents[2] / "docs" / "figures" / "pipeline.svg"
    target.parent.mkdir(parents=True, exist_ok=True)
    target.write_text(drawing())
