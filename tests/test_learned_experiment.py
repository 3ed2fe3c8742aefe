"""`experiments/learned.py --quick`: its last line says what it promises, and the promises that hang on no clock hold."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from ddprt.methods import METHODS
from ddprt.methods.floors import MeanLightmap, NearestLighting

ROOT = Path(__file__).parents[1]
FLOORS = {name for name, method in METHODS.items() if issubclass(method, MeanLightmap | NearestLighting)}
CANNOT = {"sh-prt"}  # knows no lamps


@pytest.mark.slow
def test_the_last_line_holds_every_promised_figure() -> None:
    ran = subprocess.run([sys.executable, "experiments/learned.py", "--quick"], cwd=ROOT, capture_output=True, text=True)
    assert ran.returncode == 0, ran.stderr[-2000:]
    answer = json.loads(ran.stdout.splitlines()[-1])
    assert {*answer["methods"], "svd-ridge"} == {*METHODS} - FLOORS
    for name, own in {**answer["methods"], "svd-ridge": answer["baseline"]}.items():
        if name in CANNOT:
            assert own["why"].startswith("sh-prt: got a light of type point")
            continue
        assert 0 < own["relative_rmse"]["mean"] < 1, name
        assert own["relative_rmse"]["std"] > 0, name
        assert min(own[key] for key in ("bytes", "frame_us", "train_seconds")) > 0, name
    assert answer["subspace_angle_deg"] < 1
    assert answer["resume_bit_identical"] is True
    assert 0 < answer["mlp_of_product_bound"] <= 1.5  # products alone take less, but on a busy machine not always
    assert (answer["mlp_over_torch"] is None) == answer["torch"].startswith("not measured")
