"""Migrations: a store of version 0, made by hand, becomes one of the present version, interrupted or not."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zarr

from schemas import migrations
from schemas.errors import StoreError
from schemas.layout import SCHEMA_VERSION
from schemas.migrations import MIGRATIONS, migrate
from schemas.scene_store import SceneStore
from schemas.verify import verify

SIMILARITY = {"scale": 0.5, "translation": [1.0, 2.0, 3.0]}


def _version_0(path: Path) -> Path:
    """The layout of the design's draft: one run, at the root; similarity an attribute of the root; no records."""
    attributes = {"format": "cat3d-scene", "schema_version": 0, "scene_id": "fox", "similarity": SIMILARITY}
    root = zarr.create_group(str(path), attributes=attributes)
    for name in ("captured/image", "plan/group", "generated/latent", "renders/test/image"):
        root.create_array(name, shape=(2, 3), chunks=(1, 3), dtype="f4")[:] = np.arange(6).reshape(2, 3)
    return path


def _check(path: Path) -> None:
    store = SceneStore.open(path)
    assert (store.attrs["schema_version"], store.scene_id, store.dataset) == (SCHEMA_VERSION, "fox", "unknown")
    assert store.captured.attrs["similarity"] == SIMILARITY
    assert "similarity" not in store.attrs
    assert store.runs() == ["default"]
    run = store.run("default")
    for section, name in ((store.captured, "image"), (run.plan, "group"), (run.generated, "latent")):
        assert section.read(name).tolist() == [[0, 1, 2], [3, 4, 5]]
    assert run.renders("test").names() == ["image"]
    assert {p.kind for p in verify(store)} == {"unchecked"}  # its arrays never had checksums


def test_opening_for_writing_brings_an_old_store_up_to_date(tmp_path: Path) -> None:
    path = _version_0(tmp_path / "old.zarr")
    with pytest.raises(StoreError, match="older schema version 0: open it once for writing"):
        SceneStore.open(path)
    SceneStore.open(path, "r+")
    _check(path)
    assert migrate(path) == SCHEMA_VERSION  # nothing to do any more


def test_a_migration_may_be_interrupted_at_any_write(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = _version_0(tmp_path / "old.zarr")
    write = migrations.write_group
    interrupted = 0

    def one_more_write(budget: int) -> Any:
        left = [budget]

        def limited(folder: Path, attributes: Any) -> None:
            if left[0] == 0:
                raise KeyboardInterrupt
            left[0] -= 1
            write(folder, attributes)

        return limited

    for budget in range(50):
        monkeypatch.setattr(migrations, "write_group", one_more_write(budget))
        try:
            migrate(path)
            break
        except KeyboardInterrupt:
            interrupted += 1
    assert interrupted >= 3
    _check(path)


def test_every_older_version_has_a_way_and_a_newer_one_is_refused(tmp_path: Path) -> None:
    assert sorted(MIGRATIONS) == list(range(SCHEMA_VERSION))
    path = _version_0(tmp_path / "new.zarr")
    document = json.loads((path / "zarr.json").read_text())
    document["attributes"]["schema_version"] = SCHEMA_VERSION + 1
    (path / "zarr.json").write_text(json.dumps(document))
    with pytest.raises(StoreError, match="update cat3d"):
        migrate(path)


def test_a_gap_between_versions_is_a_sentence(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delitem(MIGRATIONS, 0)
    with pytest.raises(StoreError, match="from which no migration leads on"):
        migrate(_version_0(tmp_path / "old.zarr"))
