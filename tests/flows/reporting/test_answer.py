"""The answer a report opens with: over the same scenes for every method, with what each costs."""

from __future__ import annotations

from typing import Any

import pytest

from flows.reporting.answer import answers, best_runs, rivals


def row(
    scene: str, method: str, psnr_db: float | None, seconds: float | None = 10.0, seed: int = 0, **more: Any
) -> dict:
    base = {"scene_id": scene, "method": method, "psnr_db": psnr_db, "seconds": seconds, "seed": seed}
    return base | {"split": "3", "protocol": "google", "run": f"v3-{method}" + f"-s{seed}" * bool(seed)} | more


def test_the_winner_is_that_of_scenes_which_both_methods_did() -> None:
    rows = [row("a", "zipnerf", 20.0, 5.0), row("a", "cat3d", 23.0, 30.0), row("b", "zipnerf", 22.0, 7.0),
            row("b", "cat3d", 21.0, 50.0), row("c", "zipnerf", 40.0)]  # fmt: skip
    [answer] = answers(rows)
    assert answer.scenes == 2
    assert [(s.method, s.psnr_db, s.seconds, s.best_on) for s in answer.standings] == [
        ("cat3d", 22.0, 40.0, 1), ("zipnerf", 21.0, 6.0, 1),
    ]  # fmt: skip
    assert answer.gain_db.value == pytest.approx(1.0)
    for part in ("cat3d beats zipnerf by 1.0 dB", "22.00 against 21.00", "best on 1 of 2", "40 s against 6 s"):
        assert part in answer.sentence


def test_equal_methods_a_single_one_and_nothing() -> None:
    assert "are equal" in answers([row("a", "zipnerf", 20.0), row("a", "cat3d", 20.05)])[0].sentence
    alone = answers([row("a", "zipnerf", 20.0, None, split="all")])[0]
    assert alone.gain_db is None
    assert alone.sentence == "With the split all, zipnerf reaches 20.00 dB on one scene."
    assert answers([]) == []
    assert answers([row("a", "zipnerf", None)]) == []
    assert answers([row("a", "zipnerf", 20.0), row("b", "cat3d", 20.0)]) == [], "no scene in common"


def test_more_seeds_say_whether_a_gain_is_noise() -> None:
    def rows(gains: list[float]) -> list[dict]:
        pairs = [(row("a", "zipnerf", 20.0 + 0.2 * s, seed=s), row("a", "cat3d", 20.0 + 0.2 * s + gain, seed=s))
                 for s, gain in enumerate(gains)]  # fmt: skip
        return [one for pair in pairs for one in pair]

    assert "cat3d beats zipnerf by 2.0 ± 0.2 dB" in answers(rows([2.0] * 5))[0].sentence
    assert "cat3d and zipnerf are equal within the noise of seeds" in answers(rows([0.2] * 5))[0].sentence
    assert "one seed does not say how much of that is noise" in answers(rows([2.0]))[0].sentence


def test_a_scene_counts_once_however_many_seeds_it_has() -> None:
    rows = [row("a", "zipnerf", 20.0), row("a", "zipnerf", 22.0, seed=1), row("b", "zipnerf", 31.0)]
    assert answers(rows)[0].standings[0].psnr_db == pytest.approx(26.0)


def test_one_protocol_answers_and_splits_come_by_size() -> None:
    rows = [row("a", "zipnerf", 20.0, split=s, protocol=p) for s in ("9", "all", "3") for p in ("3dgs", "google")]
    assert [a.split for a in answers(rows)] == ["3", "9", "all"]


def test_a_run_is_compared_with_the_best_of_another_method_and_the_same_seed() -> None:
    rows = [
        row("a", "zipnerf", 20.0), row("a", "cat3d", 23.0), row("a", "splats", 21.0), row("a", "cat3d", 25.0, seed=1),
    ]  # fmt: skip
    assert rivals(rows) == {
        ("a", "v3-zipnerf"): "v3-cat3d", ("a", "v3-cat3d"): "v3-splats", ("a", "v3-splats"): "v3-cat3d",
    }  # fmt: skip
    assert best_runs(rows, "3") == {"a": "v3-cat3d-s1"}
