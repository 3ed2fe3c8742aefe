"""What effects are worth to layers: `ddprt bench --effects` beside the lightmap."""

import json
from pathlib import Path

import numpy as np
import pytest

from ddprt.config import checked
from ddprt.pipeline import Run


def test_layers_are_compared_as_the_lightmap_is(tmp_path: Path) -> None:
    """In a closed sphere of albedo a, of light of one bounce a share a is missing, at probes as on texels."""
    a = 0.6
    config = checked(
        {
            "scene": {"name": "furnace", "parameters": {"albedo": a, "subdivisions": 3}},
            "atlas": {"resolution": 24},
            "lightings": {"train": 1, "validation": 1, "test": 1, "region_low": [0.5] * 3, "region_high": [0.5001] * 3},
            "points": {"count": 4, "supersample": 1},
            "transport": {"test_samples": 64, "threads": 2},
            "probes": {"grid": [1, 1, 1], "rays": 1024},
            "bench": {"repeats": 1},
        }
    )
    run = Run(config, tmp_path, quiet=True)
    text = run.ablate()
    rows = {row["variant"]: row for row in map(json.loads, (tmp_path / "bench" / "effects.jsonl").read_text().splitlines())}
    assert list(rows) == ["as planned", "without probes", "0 bounces", "1 bounce"]
    assert rows["as planned"]["layers"]["probes"]["relative_rmse"] == 0
    assert rows["without probes"]["layers"]["probes"]["relative_rmse"] == 1
    assert rows["without probes"]["relative_rmse"] == 0, "the lightmap needs none"
    assert rows["without probes"]["rays"] < rows["as planned"]["rays"]
    assert rows["0 bounces"]["layers"]["probes"]["relative_rmse"] == 1
    # 1024 rays of a lattice tell the mean to less than 1 / 32; facets depart by 1 % (tests/test_effects.py).
    assert rows["1 bounce"]["layers"]["probes"]["relative_rmse"] == pytest.approx(a, abs=1 / 32 + 0.01)
    assert np.isfinite(rows["1 bounce"]["layers"]["probes"]["noise"])
    assert rows["1 bounce"]["layers"]["probes"]["noise"] < 0.05
    heading, _, *lines = text.splitlines()
    assert heading.endswith("| probes | noise |")
    assert {line.count("|") for line in (heading, *lines)} == {heading.count("|")}
