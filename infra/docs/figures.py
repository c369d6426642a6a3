"""`make figures`: every picture of the documents, and README's table of quality, from what runs and benchmarks left.

python -m infra.docs.figures                             # charts alone need nothing but the repository's tables
python -m infra.docs.figures --showcase outputs/showcase # the strip and the picture of the report
python -m infra.docs.figures --sweep outputs/sweep       # README's table of quality
"""

from __future__ import annotations

import argparse
import shutil
import subprocess
import tempfile
from pathlib import Path

from infra.docs import pipeline_drawing, quality
from infra.docs.charts import CHARTS

ROOT = Path(__file__).resolve().parents[2]
DOCS, FIGURES = ROOT / "docs", ROOT / "docs/figures"
#: The run of infra/docs/showcase.yaml that the strip shows.
STRIP_RUN = "v3-cat3d"
REPORT_WIDTH, REPORT_HEIGHT = 1100, 1000
BROWSER_FLAGS = (
    "--headless=new", "--no-sandbox", "--disable-gpu", "--no-first-run", "--hide-scrollbars", "--disable-sync",
    "--disable-background-networking", "--disable-component-update",
)  # fmt: skip


def charts() -> None:
    """Charts from tables in the repository; equal tables give equal files."""
    for name, draw in CHARTS.items():
        path = FIGURES / name
        draw(DOCS).savefig(path, dpi=110, metadata={"Date": None} if path.suffix == ".svg" else None)
        print(path.relative_to(ROOT))


def strip(showcase: Path) -> None:
    """The strip of pictures, of the only scene of the folder."""
    from infra.docs.strip import write_strip

    stores = sorted(showcase.glob("*.zarr"))
    if not stores:
        print(f"No strip: {showcase} holds no scene; `make figures` makes one.")
        return
    for path in write_strip(stores[0], STRIP_RUN, FIGURES):
        print(path.relative_to(ROOT))


def report(showcase: Path) -> None:
    """A picture of the folder's report in a browser."""
    page, out = showcase / "report.html", FIGURES / "report.png"
    browser = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    if browser is None or not page.exists():
        lacking = "Chromium is not installed" if browser is None else f"there is no {page}"
        print(f"No new picture of the report: {lacking}.")
        return
    with tempfile.TemporaryDirectory() as profile:
        flags = [*BROWSER_FLAGS, f"--user-data-dir={profile}"]
        size = f"--window-size={REPORT_WIDTH},{REPORT_HEIGHT}"
        subprocess.run([browser, *flags, size, f"--screenshot={out}", page.resolve().as_uri()], check=True,
                       capture_output=True, timeout=300)  # fmt: skip
    import numpy as np
    from PIL import Image

    from infra.docs.strip import save

    save(np.asarray(Image.open(out).convert("RGB")), out)
    print(out.relative_to(ROOT))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--showcase", type=Path, help="What `cat3d sweep infra/docs/showcase.yaml` left.")
    parser.add_argument("--sweep", type=Path, help="A sweep's folder, for README's table of quality.")
    given = parser.parse_args()
    FIGURES.mkdir(exist_ok=True)
    pipeline_drawing.main()
    charts()
    if given.showcase is not None:
        strip(given.showcase)
        report(given.showcase)
    if given.sweep is not None:
        quality.write_table(ROOT / "README.md", given.sweep)
        print("README.md: table of quality")


if __name__ == "__main__":
    main()
