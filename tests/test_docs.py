"""The documents: links lead somewhere, figures and tables exist, generated pages say what the code says."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md"), *(ROOT / "infra").rglob("*.md")])
LINK = re.compile(r"!?\[[^\]]*\]\(([^)\s]+)\)|<img[^>]*src=\"([^\"]+)\"|^\[[^\]]+\]: (\S+)$", re.M)
#: Written by a program from measurements, or a record of the past: their lines may be long.
FREE = {ROOT / "docs/reference/benchmarks.md", *(ROOT / "docs/log").glob("*.md")}
LONGEST, LONGEST_ROW, README_LINES, PICTURE_BYTES = 100, 150, 120, 300_000
#: Written by a program: as many columns as there are number formats.
WIDE = FREE | {ROOT / "docs/reference/stress.md"}


def anchors(page: Path) -> set[str]:
    """Names that the headings of a page can be linked by."""
    titles = re.findall(r"^#+ (.+)$", page.read_text(), re.M)
    return {re.sub(r"[^\w\- ]", "", title.lower()).strip().replace(" ", "-") for title in titles}


@pytest.mark.parametrize("page", PAGES, ids=lambda p: str(p.relative_to(ROOT)))
def test_links_and_figures_lead_somewhere(page: Path) -> None:
    missing = []
    for match in LINK.finditer(page.read_text()):
        target = next(filter(None, match.groups()))
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


@pytest.mark.parametrize("page", [p for p in PAGES if p not in FREE], ids=lambda p: str(p.relative_to(ROOT)))
def test_commands_and_options_of_the_documents_exist(page: Path) -> None:
    """Every `cat3d NAME --option`, and every setting of a run that is given by --set."""
    import typer

    from flows.cli import app

    commands = typer.main.get_command(app).commands  # type: ignore[attr-defined]
    wrong = []
    for name, rest in re.findall(r"(?:^    |`)cat3d ([a-z-]+)([^`#\n]*)", page.read_text(), re.M):
        if name not in commands:
            wrong.append(f"cat3d {name}")
            continue
        known = {
            option for parameter in commands[name].params for option in (*parameter.opts, *parameter.secondary_opts)
        }
        options = re.findall(r"(?<!\S)--?[a-z][a-z-]*", rest)
        wrong += [f"cat3d {name} {option}" for option in options if option not in known]
        if name in ("run", "plan", "reprocess"):
            wrong += [f"--set {path}" for path in re.findall(r"--set ([\w.]+)=", rest) if not is_setting(path)]
    assert not wrong, f"{page.relative_to(ROOT)}: {wrong}"


def is_setting(path: str) -> bool:
    """Whether a run has the setting; below a field that holds a mapping anything may stand."""
    from schemas.config import RunConfig

    model = RunConfig
    for part in path.split("."):
        if not hasattr(model, "model_fields"):
            return True
        if part not in model.model_fields:
            return part == "method"  # the short name of `generate`
        model = model.model_fields[part].annotation
    return True


def prose(page: Path) -> list[str]:
    """Lines of a page outside of code blocks, tables and comments, which hold what programs wrote."""
    text = re.sub(r"^```.*?^```", "", page.read_text(), flags=re.M | re.S)
    return [line for line in text.splitlines() if not line.startswith(("    ", "|", "<!--"))]


@pytest.mark.parametrize("page", [p for p in PAGES if p not in FREE], ids=lambda p: str(p.relative_to(ROOT)))
def test_lines_of_prose_are_short(page: Path) -> None:
    long = [line for line in prose(page) if len(line) > LONGEST]
    assert not long, f"{page.relative_to(ROOT)} has lines of over {LONGEST} characters: {long}"


@pytest.mark.parametrize("page", [p for p in PAGES if p not in WIDE], ids=lambda p: str(p.relative_to(ROOT)))
def test_rows_of_tables_are_short(page: Path) -> None:
    long = [line for line in page.read_text().splitlines() if line.startswith("|") and len(line) > LONGEST_ROW]
    assert not long, f"{page.relative_to(ROOT)} has rows of over {LONGEST_ROW} characters: {long}"


def test_readme_is_short_and_shows_pictures() -> None:
    readme = ROOT / "README.md"
    lines = readme.read_text().splitlines()
    assert len(lines) <= README_LINES
    assert all(len(line) <= LONGEST for line in lines)
    paragraphs = "\n".join(prose(readme)).split("\n\n")
    assert all(len(p.splitlines()) <= 4 for p in paragraphs if not p.startswith(("- ", "[")))
    text = re.sub(r"\]\([^)]*\)|`[^`]*`|^\[[^\]]+\]: .*$|<!--.*", "", "\n".join(prose(readme)), flags=re.M)
    assert len(re.findall(r"(?<![\w-])\d[\d.,]*", text)) < 15, "numbers in README's prose"
    pictures = {ROOT / p for p in re.findall(r"docs/figures/[\w.]+", readme.read_text())}
    assert len(pictures) >= 5
    assert all(picture.stat().st_size < PICTURE_BYTES for picture in pictures)
    assert not re.findall(r"!\[\]", readme.read_text()), "every picture has alternative text"


def test_readmes_table_of_quality(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Means over scenes, errors over seeds, gain, and what the numbers are of; nothing of other splits."""
    from infra.docs import quality

    def row(method: str, seed: int, psnr: float, split: str = "3") -> dict[str, object]:
        return {
            "dataset": "llff",
            "scene_id": "a",
            "method": method,
            "split": split,
            "seed": seed,
            "protocol": "google",
            "psnr_db": psnr,
        }

    rows = [row("zipnerf", 0, 20.0), row("zipnerf", 1, 22.0), row("cat3d", 0, 24.0), row("cat3d", 1, 25.0)]
    rows += [row("cat3d", 0, 99.0, "6"), row("other", 0, 99.0)]
    monkeypatch.setattr(quality, "summary_rows", lambda _: rows)
    monkeypatch.setattr(quality, "_last_day", lambda _: "2026-11-28")
    text = quality.table(tmp_path)
    assert "| things before a wall, from the front | 21.0 ± 1.0 | 24.5 ± 0.5 | +3.5 ± 1.1 ≈ | +4.3 |" in text
    prose = " ".join(text.split("\n\n")[1].split())
    assert "one scene a row; ± is the standard error over two seeds" in prose
    rows[:] = rows[:2]
    with pytest.raises(ValueError, match="no data set with 3 views of both zipnerf and cat3d"):
        quality.table(tmp_path)
