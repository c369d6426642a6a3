"""How well wrong cameras are found: false alarms and seconds on scenes as they are, and random damage that is caught.

Damage changes cameras or, what is the same, turns or bends the rays of features that were found once per scene.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from flows.readers import read_capture
from flows.sfm.consistency import Evidence, evidence, judge
from flows.sfm.matches import Features

#: Procedural scenes, where there is no folder of real ones.
PROCEDURAL = tuple(f"procedural:{family}/3?views=16&width=320&height=240" for family in ("dtu", "llff", "mip360"))
#: Of the real scenes these have cameras that are wrong as they come (docs/explanation/poses.md).
KNOWN_WRONG = ("re10k_bedroom", "mipnerf360_bonsai")


@dataclass(frozen=True)
class Looked:
    """A scene with what its photos say: poses (N, 4, 4) world_from_camera; seconds that finding it took."""

    name: str
    views: list[str]
    poses: np.ndarray
    known: Evidence
    seconds: float


Damage = Callable[[np.random.Generator, np.ndarray, Evidence], tuple[np.ndarray, Evidence, set[int]]]
DAMAGES: dict[str, Damage] = {}


def damage(name: str) -> Callable[[Damage], Damage]:
    """Register damage(random, poses, evidence) -> what they become, and the views that are wrong."""

    def register(apply: Damage) -> Damage:
        DAMAGES[name] = apply
        return apply

    return register


def look(source: str | Path) -> Looked:
    """Read a scene and find its evidence."""
    capture = read_capture(source)
    assert capture.cameras is not None
    started = time.process_time()
    known = evidence(capture)
    poses = capture.cameras.world_from_camera.double().numpy()
    return Looked(capture.scene_id, capture.names, poses, known, time.process_time() - started)


def rows(sources: Sequence[str | Path], trials: int, seed: int = 0) -> list[dict[str, Any]]:
    """A row for each scene as it is, then one for each kind of damage: how many of its trials were caught, and, where
    few views were wrong, in how many one of those was named."""
    scenes = [look(source) for source in sources]
    out: list[dict[str, Any]] = []
    for scene in scenes:
        found = judge(scene.poses, scene.known)
        out.append(
            {
                "scene": scene.name,
                "views": len(scene.known.found),
                "pairs": len(found.pairs),
                "contradictory": len(found.bad_pairs),
                "warned": bool(found.warnings(scene.views)),
                "known_wrong": scene.name in KNOWN_WRONG,
                "cpu_seconds": scene.seconds + found.seconds,
            }
        )
    sound = [scene for scene in scenes if scene.name not in KNOWN_WRONG]
    random = np.random.default_rng(seed)
    tried: dict[str, list[tuple[bool, bool | None]]] = {name: [] for name in DAMAGES}
    for trial in range(trials):
        name = list(DAMAGES)[trial % len(DAMAGES)]
        scene = sound[trial // len(DAMAGES) % len(sound)]
        poses, known, wrong = DAMAGES[name](random, scene.poses.copy(), scene.known)
        found = judge(poses, known)
        few = len(wrong) <= len(poses) // 3
        tried[name].append((bool(found.blamed), bool(wrong & set(found.blamed)) if few else None))
    for name, results in tried.items():
        named = [right for _, right in results if right is not None]
        row = {"damage": name, "trials": len(results), "caught": sum(caught for caught, _ in results)}
        out.append(row | {"named_right": sum(named) if named else None})
    every = [caught for results in tried.values() for caught, _ in results]
    return [*out, {"damage": "all", "trials": len(every), "caught": sum(every)}]


def _some(random: np.random.Generator, poses: np.ndarray, count: int = 1) -> list[int]:
    return [int(v) for v in random.choice(len(poses), count, replace=False)]


def _rays(known: Evidence, views: set[int], change: Callable[[np.ndarray], np.ndarray]) -> Evidence:
    found: dict[int, Features] = {
        v: replace(f, rays=change(f.rays)) if v in views else f for v, f in known.found.items()
    }
    return replace(known, found=found)


def _rotation(axis: np.ndarray, angle: float) -> np.ndarray:
    x, y, z = axis / np.linalg.norm(axis)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


@damage("one view has another's pose")
def one_of_another(random, poses, known):
    a, b = _some(random, poses, 2)
    poses[a] = poses[b]
    return poses, known, {a}


@damage("two poses are exchanged")
def exchanged(random, poses, known):
    a, b = _some(random, poses, 2)
    poses[[a, b]] = poses[[b, a]]
    return poses, known, {a, b}


@damage("poses are those of the next view from one on")
def shifted(random, poses, known):
    start = int(random.integers(1, max(2, len(poses) // 2)))
    poses[start:] = np.roll(poses[start:], -1, axis=0)
    return poses, known, set(range(start, len(poses)))


@damage("poses are in random order")
def shuffled(random, poses, known):
    return poses[random.permutation(len(poses))], known, set(range(len(poses)))


@damage("all poses are inverse")
def inverse(random, poses, known):
    return np.linalg.inv(poses), known, set(range(len(poses)))


@damage("camera axes are OpenGL's")
def opengl(random, poses, known):
    return poses * np.array([1.0, -1, -1, 1]), known, set(range(len(poses)))


@damage("all photos are turned by 180 degrees")
def all_turned(random, poses, known):
    views = set(known.found)
    return poses, _rays(known, views, lambda rays: -rays), set(range(len(poses)))


@damage("a quarter of the photos is turned by 180 degrees")
def some_turned(random, poses, known):
    views = set(_some(random, poses, max(1, len(poses) // 4)))
    return poses, _rays(known, views, lambda rays: -rays), views


@damage("all photos are turned by 90 degrees")
def quarter_turned(random, poses, known):
    views = set(known.found)
    return poses, _rays(known, views, lambda rays: np.stack([-rays[:, 1], rays[:, 0]], -1)), set(range(len(poses)))


@damage("intrinsics are of images twice to eight times as large")
def larger(random, poses, known):
    factor = float(random.choice([2.0, 4.0, 8.0]))
    extent = {v: np.abs(f.rays).max(0) for v, f in known.found.items()}
    found = {v: replace(f, rays=f.rays / factor - extent[v] * (1 - 1 / factor)) for v, f in known.found.items()}
    return poses, replace(known, found=found), set(range(len(poses)))


@damage("focal length is wrong by 15 to 50 percent")
def focal(random, poses, known):
    factor = float(random.uniform(1.15, 1.5) ** random.choice([-1, 1]))
    return poses, _rays(known, set(known.found), lambda rays: rays * factor), set(range(len(poses)))


@damage("a lens's distortion is left out (k1 of -0.3 to -0.1)")
def bent(random, poses, known):
    k1 = float(random.uniform(-0.3, -0.1))
    views = set(known.found)
    return poses, _rays(known, views, lambda r: r * (1 + k1 * (r**2).sum(1, keepdims=True))), set(range(len(poses)))


@damage("one camera is turned by 2 to 20 degrees")
def one_rotated(random, poses, known):
    (view,) = _some(random, poses)
    angle = np.radians(random.uniform(2, 20))
    poses[view, :3, :3] = poses[view, :3, :3] @ _rotation(random.normal(size=3), angle)
    return poses, known, {view}


@damage("one camera is moved by 10 to 50 percent of the extent")
def one_moved(random, poses, known):
    (view,) = _some(random, poses)
    extent = np.linalg.norm(poses[:, :3, 3] - poses[:, :3, 3].mean(0), axis=1).max()
    way = random.normal(size=3)
    poses[view, :3, 3] += way / np.linalg.norm(way) * extent * random.uniform(0.1, 0.5)
    return poses, known, {view}


@damage("the second half is from another reconstruction (turned, moved and scaled)")
def two_models(random, poses, known):
    half = len(poses) // 2
    similarity = np.eye(4)
    similarity[:3, :3] = _rotation(random.normal(size=3), random.uniform(0.3, 3))
    similarity[:3, 3] = random.normal(size=3)
    poses[half:] = similarity @ poses[half:]
    poses[half:, :3, 3] *= random.uniform(1.5, 3)
    return poses, known, set(range(half, len(poses)))
