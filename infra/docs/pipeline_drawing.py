"""Draws the pipeline as docs/figures/pipeline.svg: plain SVG, readable on a light and on a dark page."""

from __future__ import annotations

from html import escape
from pathlib import Path
from typing import NamedTuple


class Box(NamedTuple):
    """What stands in one place of the grid: a name, and what it makes."""

    made: str
    column: int
    row: int


#: The middle row makes views and is left out where none are generated; the row below it makes the scene.
BOXES = {
    "photos": Box("3 to 9, or one", 0, 0),
    "ingest": Box("pixels, lens undone", 1, 0),
    "poses": Box("cameras", 2, 0),
    "plan": Box("cameras to generate", 0, 1),
    "match": Box("what the photos show", 1, 1),
    "encode": Box("latents of photos", 2, 1),
    "sample": Box("latents of new views", 3, 1),
    "decode": Box("generated views", 4, 1),
    "reconstruct": Box("one 3D scene", 2, 2),
    "render": Box("views and depth", 3, 2),
    "evaluate": Box("metrics, report", 4, 2),
}
GENERATIVE = {"plan", "match", "encode", "sample", "decode"}
WIDTH, HEIGHT, GAP_X, GAP_Y, MARGIN = 150, 56, 34, 54, 10


def left(name: str) -> int:
    return MARGIN + BOXES[name].column * (WIDTH + GAP_X)


def top(name: str) -> int:
    return MARGIN + BOXES[name].row * (HEIGHT + GAP_Y)


def box(name: str) -> str:
    """A stage: its name and what it makes."""
    colour = "#a8521a" if name in GENERATIVE else "#00796b"
    middle = left(name) + WIDTH // 2
    return (
        f'<rect x="{left(name)}" y="{top(name)}" width="{WIDTH}" height="{HEIGHT}" rx="8" fill="{colour}"/>'
        f'<text x="{middle}" y="{top(name) + 24}" class="name">{escape(name)}</text>'
        f'<text x="{middle}" y="{top(name) + 43}" class="made">{escape(BOXES[name].made)}</text>'
    )


def line(points: list[tuple[int, int]]) -> str:
    """An arrow along corners, none of which lies in a box."""
    path = "M" + "L".join(f"{x} {y}" for x, y in points)
    return f'<path d="{path}" class="arrow" marker-end="url(#head)"/>'


def across(first: str, second: str) -> str:
    """From the right edge of a box to the left edge of the next one in its row."""
    y = top(first) + HEIGHT // 2
    return line([(left(first) + WIDTH, y), (left(second), y)])


def down(first: str, second: str, shift: int = 0) -> str:
    """From the lower edge of a box to the upper edge of one below, through the gap between the rows."""
    x0, x1 = left(first) + WIDTH // 2, left(second) + WIDTH // 2 + shift
    bend = top(second) - GAP_Y // 2
    return line([(x0, top(first) + HEIGHT), (x0, bend), (x1, bend), (x1, top(second))])


def drawing() -> str:
    """The whole picture."""
    width = left("decode") + WIDTH + 2 * MARGIN
    height = top("evaluate") + HEIGHT + MARGIN
    arrows = [
        across("photos", "ingest"), across("ingest", "poses"),
        down("poses", "plan"), down("poses", "encode"),
        across("plan", "match"), across("match", "encode"), across("encode", "sample"), across("sample", "decode"),
        down("decode", "reconstruct", 30), across("reconstruct", "render"), across("render", "evaluate"),
    ]  # fmt: skip
    # Captured views go to the reconstruction too, round the row of the generating stages.
    edge, level, bend = width - 3, top("poses") + HEIGHT // 2, top("reconstruct") - 14
    entry = left("reconstruct") + WIDTH // 2 - 30
    around = [(left("poses") + WIDTH, level), (edge, level), (edge, bend), (entry, bend), (entry, top("reconstruct"))]
    arrows.append(line(around))
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" role="img">',
        "<title>Photos become cameras, a plan, generated views, one 3D scene, renders and metrics</title>",
        "<style>text{font-family:sans-serif;text-anchor:middle;fill:#fff}.name{font-size:16px;font-weight:bold}"
        ".made{font-size:13px}.arrow{stroke:#888;stroke-width:2;fill:none}</style>",
        '<marker id="head" viewBox="0 0 8 8" refX="7" refY="4" markerWidth="7" markerHeight="7" orient="auto">'
        '<path d="M0 0L8 4L0 8z" fill="#888"/></marker>',
        *arrows,
        *map(box, BOXES),
        "</svg>",
    ]
    return "\n".join(parts) + "\n"


def main() -> None:
    """Write the drawing where the documents look for it."""
    target = Path(__file__).resolve().parents[2] / "docs" / "figures" / "pipeline.svg"
    target.parent.mkdir(parents=True, exist_ok=True)
    target.write_text(drawing(), encoding="utf-8")


if __name__ == "__main__":
    main()
