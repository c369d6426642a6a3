"""Accuracy and time of pose estimation against the known cameras of real scenes, as rows for docs/explanation/poses.md.

    python -m flows.bench.poses DATA [--scenes NAME ...] [--features 4000 ...] [--views all ...] [--out rows.jsonl]

DATA holds scene folders with cameras; the cameras are hidden, estimated from the photos alone, aligned by one
similarity, and compared.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from pathlib import Path
from typing import Any

import torch

from cat3d_core.alignment import pose_errors
from flows.readers import read_capture
from flows.readers.splits import linspace_ids
from flows.sfm.poses import PoseError, PoseSettings, estimate_poses

# Scene: how many of its views, evenly spread.
SCENES = {"llff_fern": 20, "llff_flower": 17, "strecha_fountain_P11": 11, "fox": 17, "dtu_scan24": 25, "co3d_apple": 20}


def measure(scene: Path, views: int, features: int, seed: int = 0) -> dict[str, Any]:
    """One row: errors of the registered photos, or why it failed. Few views are the scene's own training split."""
    capture = read_capture(scene)
    if capture.cameras is None:
        raise ValueError(f"{scene} has no cameras to compare with.")
    few = str(views) in capture.splits
    ids = (
        sorted(capture.splits[str(views)]["train"])
        if few
        else linspace_ids(range(len(capture)), min(views, len(capture)))
    )
    row: dict[str, Any] = {"scene": scene.name, "views": len(ids), "features": features, "seed": seed}
    start = time.perf_counter()
    try:
        result = estimate_poses([capture.paths[i] for i in ids], seed, settings=PoseSettings(max_features=features))
    except PoseError:
        return row | {"registered": 0, "seconds": time.perf_counter() - start}
    truth = capture.cameras[[ids[i] for i in result.registered]]
    errors = pose_errors(result.cameras, truth)
    return row | {
        "registered": len(result.registered),
        "attempt": result.report.attempt,
        "points": result.report.points,
        "reprojection_px": result.report.reprojection_error_px,
        "rotation_deg_median": float(errors.rotation_deg.median()),
        "rotation_deg_max": float(errors.rotation_deg.max()),
        "center_share_median": float(errors.center_share.median()),
        "center_share_max": float(errors.center_share.max()),
        "focal_ratio": float((result.cameras.intrinsics[:, 0, 0] / truth.intrinsics[:, 0, 0]).median()),
        "seconds": time.perf_counter() - start,
        "load": os.getloadavg()[0],
    }


def as_markdown(rows: list[dict[str, Any]]) -> str:
    """The rows as a table."""
    lines = [
        "| scene | photos | features | registered | attempt | rotation error, deg (median / max) "
        "| centre error, % of extent (median / max) | focal / true | s |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for r in rows:
        head = f"| {r['scene']} | {r['views']} | {r['features']} | {r['registered']} |"
        if r["registered"] == 0:
            lines.append(f"{head} refused with a message | | | | {r['seconds']:.0f} |")
        else:
            lines.append(
                f"{head} {r['attempt']} | {r['rotation_deg_median']:.2f} / {r['rotation_deg_max']:.2f} "
                f"| {100 * r['center_share_median']:.2f} / {100 * r['center_share_max']:.2f} "
                f"| {r['focal_ratio']:.3f} | {r['seconds']:.0f} |"
            )
    return "\n".join(lines)


def main() -> None:
    """Measure, print the table, and append the rows to --out."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("--scenes", nargs="+", default=list(SCENES))
    parser.add_argument("--features", nargs="+", type=int, default=[PoseSettings().max_features])
    parser.add_argument(
        "--views", nargs="+", default=["all"], help='numbers of views, or "all" for the scene\'s default'
    )
    parser.add_argument("--out", type=Path)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    rows = []
    for scene in arguments.scenes:
        for views in arguments.views:
            count = SCENES.get(scene, 16) if views == "all" else int(views)
            for features in arguments.features:
                rows.append(measure(arguments.data / scene, count, features))
                if arguments.out:
                    with arguments.out.open("a") as stream:
                        stream.write(json.dumps(rows[-1]) + "\n")
    print(as_markdown(rows))


if __name__ == "__main__":
    main()
