"""The documents: links lead somewhere, figures and tables exist, generated pages say what the code says."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md"), *(ROOT / "infra").rglob("*.md")])
#: Lines that may be longer than 100 characters: tables, code, links alone, and what a program wrote.
LINK = re.compile(r"!?\[[^\]]*\]\(([^)\s]+)\)|<img[^>]*src=\"([^\"]+)\"")


def anchors(page: Path) -> set[str]:
    """Names that the headings of a page can be linked by."""
    titles = re.findall(r"^#+ (.+)$", page.read_text(), re.M)
    return {re.sub(r"[^\w\- ]", "", title.lower()).strip().replace(" ", "-") for title in titles}


@pytest.mark.parametrize("page", PAGES, ids=lambda p: str(p.relative_to(ROOT)))
def test_links_and_figures_lead_somewhere(page: Path) -> None:
    missing = []
    for match in LINK.finditer(page.read_text()):
        target = match.group(1) or match.group(2)
        if re.match(r"[a-z]+:", target):
            continue  # an address in the net: not asked here
        path, _, anchor = target.partition("#")
        file = (page.parent / path).resolve() if path else page
        if not file.exists() or (anchor and file.suffix == ".md" and anchor not in anchors(file)):
            missing.append(target)
    assert not missing, f"{page.relative_to(ROOT)} links to what is not there: {missing}"


def test_paths_named_in_prose_and_messages_exist() -> None:
    """docs/….md in documents, code and messages."""
    wrong = []
    for folder in ("docs", "flows", "cat3d_core", "schemas", "infra", "tests"):
        for file in (ROOT / folder).rglob("*"):
            if file.suffix in {".py", ".md", ".yaml", ".sh", ".j2"} and "log" not in file.relative_to(ROOT).parts:
                wrong += [f"{file.relative_to(ROOT)}: {p}" for p in re.findall(r"docs/[\w/]+\.md", file.read_text())
                          if not (ROOT / p).exists()]  # fmt: skip
    assert not wrong, wrong


def test_generated_pages_are_what_the_code_says() -> None:
    from infra.docs.reference import stale

    assert not stale(), f"Write them with `make docs`: {stale()}"
