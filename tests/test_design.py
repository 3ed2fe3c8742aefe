"""Chosen lightings and chosen points: against slow oracles, and through a bake that stops at its target."""

import itertools
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ddprt import pipeline_active
from ddprt.config import Config
from ddprt.dataset.generate import bake
from ddprt.dataset.sameness import other_settings
from ddprt.dataset.splits import Once, choose_among, reorder
from ddprt.dataset.store import Dataset, open_dataset
from ddprt.errors import UserError
from ddprt.lights import PointLight
from ddprt.pipeline import Run
from ddprt.pipeline_active import FIRST_GROUP, group_sizes
from ddprt.progress import Progress, Stage
from ddprt.sampling.design import RIDGE, choose_columns, choose_rows, directions
from ddprt.sampling.lightings import draw_lightings
from ddprt.sampling.points import place_samples
from ddprt.scene.mesh import Scene
from ddprt.transport.embree import Tracer
from ddprt.transport.openness import build_open_atlas

SMALL: dict[str, dict[str, Any]] = {
    "atlas": {"resolution": 24},
    "lightings": {"train": 5, "validation": 2, "test": 2, "choose": "active", "candidates": 4},
    "points": {"count": 8, "supersample": 2},
    "transport": {"samples": 8, "test_samples": 8, "direct_samples": 1},
    "fit": {"bases": 3},
    "methods": {"compare": ["svd-ridge"]},
}


def small(**changes: dict[str, Any]) -> Config:
    return Config.model_validate({key: {**SMALL.get(key, {}), **changes.get(key, {})} for key in {*SMALL, *changes}})


def rows_of(seed: int, lightings: int = 9, places: int = 4) -> np.ndarray:
    return directions(np.random.default_rng(seed).exponential(size=(lightings, places, 3)) ** 2)


def mean_variance(rows: np.ndarray, chosen: list[int], ridge: float) -> float:
    """Mean variance of all rows, from the inverse of the chosen ones' kernel: no update, no feature space."""
    kernel = rows @ rows.T
    among = kernel[np.ix_(chosen, chosen)] + ridge * np.eye(len(chosen))
    return float(np.mean(np.diag(kernel - kernel[:, chosen] @ np.linalg.inv(among) @ kernel[chosen])))


@given(seed=st.integers(0, 10_000), ridge=st.sampled_from([1e-3, RIDGE, 0.5]))
@settings(max_examples=30)
def test_each_choice_lowers_the_mean_variance_most(seed: int, ridge: float) -> None:
    rows = rows_of(seed)
    found = choose_rows(rows, 5, ridge=ridge).tolist()
    for step in range(5):
        every = {j: mean_variance(rows, [*found[:step], j], ridge) for j in range(len(rows)) if j not in found[:step]}
        # Inverses of kernels with eigenvalues from the ridge to 9 are good to eps64 * 9 / 1e-3, some 2e-12.
        assert every[found[step]] <= min(every.values()) + 1e-10


def test_many_columns_and_many_candidates_agree() -> None:
    """Both ways to the diagonal of K²: a candidate has fewer or more columns than there are candidates."""
    rows = rows_of(1, 10, 3)
    padded = np.concatenate([rows, np.zeros((10, 20))], 1)
    assert choose_rows(rows, 6).tolist() == choose_rows(padded, 6).tolist()


@given(seed=st.integers(0, 10_000))
@settings(max_examples=20)
def test_columns_span_the_greatest_volume_greedily(seed: int) -> None:
    rows = np.random.default_rng(seed).normal(size=(7, 9))
    order = choose_columns(rows, 4).tolist()
    for step in range(4):
        volume = {
            j: np.linalg.det(rows[:, [*order[:step], j]].T @ rows[:, [*order[:step], j]])
            for j in range(9)
            if j not in order[:step]
        }
        # Determinants of at most four columns of length about 3 are good to some 1e4 eps64.
        assert volume[order[step]] >= max(volume.values()) * (1 - 1e-9)
    assert sorted(order) == list(range(9))
    assert order[4:] == sorted(order[4:])


def test_samples_told_apart_by_too_few_lightings_keep_their_order() -> None:
    rng = np.random.default_rng(0)
    rows = rng.normal(size=(8, 3)) @ rng.normal(size=(3, 10))  # eight lightings of rank three
    order = choose_columns(rows, 6)
    assert order[3:].tolist() == sorted(set(range(10)) - set(order[:3].tolist()))
    assert choose_columns(np.zeros((3, 4)), 2).tolist() == [0, 1, 2, 3]


@given(seed=st.integers(0, 10_000))
@settings(max_examples=20)
def test_permuted_candidates_permute_the_choice(seed: int) -> None:
    rows, turn = rows_of(seed, 12), np.random.default_rng(seed).permutation(12)
    assert turn[choose_rows(rows[turn], 6)].tolist() == choose_rows(rows, 6).tolist()


def test_a_choice_of_fewer_is_a_beginning() -> None:
    rows = rows_of(3, 12)
    assert choose_rows(rows, 4).tolist() == choose_rows(rows, 9)[:4].tolist()


def test_strength_and_colour_of_a_lone_lamp_do_not_count() -> None:
    values = np.random.default_rng(0).exponential(size=(5, 6, 1)) * np.ones(3)
    coloured = values * np.random.default_rng(1).uniform(0.1, 1e6, (5, 1, 3))
    # Products and quotients of a few float64 numbers.
    np.testing.assert_allclose(directions(coloured), directions(values), rtol=1e-14)
    np.testing.assert_allclose(np.linalg.norm(directions(values * [1, 0, 0]), axis=1), 1, rtol=1e-14)
    assert not directions(np.zeros((2, 3, 3), np.float32)).any()
    huge = np.full((1, 4, 3), np.finfo(np.float32).max, np.float32)
    np.testing.assert_allclose(np.linalg.norm(directions(huge), axis=1), 1, rtol=1e-14)


def test_repeats_and_darkness_come_last() -> None:
    values = np.random.default_rng(0).exponential(size=(4, 6, 3)).astype(np.float32)
    brighter = values[0] * np.float32(3)  # a twin but for rounding
    rows = directions(np.stack([np.zeros((6, 3), np.float32), values[0], brighter, values[1], values[0], values[2], values[3]]))
    found = choose_rows(rows, 7).tolist()
    new, left = set(found[:4]), found[4:]
    assert {3, 5, 6} < new
    assert len(new & {1, 2, 4}) == 1
    assert left == sorted(left)
    assert set(found) == set(range(7))


def test_choose_rows_refuses_what_makes_no_sense() -> None:
    with pytest.raises(ValueError, match="count: got 10"):
        choose_rows(rows_of(0), 10)
    with pytest.raises(ValueError, match="ridge: got 0"):
        choose_rows(rows_of(0), 2, ridge=0.0)


def test_threads_do_not_matter(cornell: Scene) -> None:
    samples = place_samples(cornell, 64, on="surface", seed=0)
    config = small(lightings={"kinds": ["point", "rect"]}).lightings
    tracers = [Tracer.of(cornell, threads) for threads in (1, 3)]
    drawn = draw_lightings(config, "train", 40, bounds=cornell.bounds, clearance=tracers[0].clearance, seed=0).lightings
    one, three = (choose_among(drawn, 6, samples, 16, tracer, 0) for tracer in tracers)
    assert one == three
    first, second = (reorder(samples, one, 16, tracer, 0) for tracer in tracers)
    np.testing.assert_array_equal(first.position, second.position)
    assert first.digest != samples.digest
    assert sorted(map(tuple, first.position)) == sorted(map(tuple, samples.position))


def test_lamps_all_over_are_chosen_before_their_neighbours(cornell: Scene) -> None:
    """Eight places, and at each five lamps within a millimetre: eight choices take one of each."""
    rng = np.random.default_rng(0)
    corners = np.array(list(itertools.product((0.12, 0.43), (0.35, 0.5), (0.12, 0.43))))
    lamps = [
        (PointLight(position=tuple(place + rng.uniform(0, 1e-3, 3)), intensity=(1, 1, 1)),)
        for place in corners
        for _ in range(5)
    ]
    samples = place_samples(cornell, 128, on="surface", seed=0)
    chosen = choose_among(lamps, 8, samples, 128, Tracer.of(cornell, 1), 0)
    assert {lamps.index(lighting) // 5 for lighting in chosen} == set(range(8))


@pytest.fixture(scope="module")
def active(cornell: Scene, tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    return bake(cornell, config=small(), out=tmp_path_factory.mktemp("active") / "dataset")


def test_a_bake_chooses_among_its_candidates(active: Dataset, cornell: Scene) -> None:
    config = small()
    draws = {}
    for name, count in (("train", 20), ("validation", 2), ("test", 2)):
        clearance = Tracer.of(cornell, 1).clearance
        draws[name] = draw_lightings(
            config.lightings, name, count, bounds=cornell.bounds, clearance=clearance, seed=0
        ).lightings
    chosen = [active.lightings[index] for index in active.split("train")]
    assert len(chosen) == 5
    assert set(chosen) < set(draws["train"])
    assert tuple(chosen) != draws["train"][:5]
    assert tuple(active.lightings[5:]) == draws["validation"] + draws["test"], "what is held out stays random"
    assert active.description["drawn"]["candidates"] == 20
    assert not other_settings(open_dataset(active.folder).description, config, cornell)


def test_a_chosen_dataset_is_that_of_its_list(active: Dataset, cornell: Scene, tmp_path: Path) -> None:
    lists = {name: [active.lightings[i] for i in active.split(name)] for name in ("train", "validation", "test")}
    plain = small(lightings={"choose": "random"}, points={"depth": active.samples.depth / active.samples.spacing})
    given_list = bake(cornell, lists, config=plain, out=tmp_path / "given")
    for kind in ("direct", "indirect"):
        np.testing.assert_array_equal(given_list.maps(kind, range(9)), active.maps(kind, range(9)))


def test_the_word_active_means_the_setting(active: Dataset, cornell: Scene) -> None:
    data = bake(cornell, "active", config=small(lightings={"choose": "random"}))
    assert data.description == active.description


def test_first_bakes_a_beginning_of_the_choice(active: Dataset, cornell: Scene) -> None:
    data = bake(cornell, config=small(), first=3)
    assert data.lightings == active.lightings[:3] + active.lightings[5:]


def test_points_by_qr_are_the_same_samples(cornell: Scene, active: Dataset) -> None:
    data = bake(cornell, config=small(points={"choose": "qr"}))
    assert data.lightings == active.lightings
    light = data.measured(data.split("train")) * data.samples.albedo
    rows = directions(light).reshape(light.shape).swapaxes(1, 2).reshape(-1, 16)
    assert choose_columns(rows, 8).tolist() == list(range(16))
    np.testing.assert_array_equal(np.unique(data.samples.position, axis=0), np.unique(active.samples.position, axis=0))
    assert data.samples.depth == active.samples.depth


@pytest.mark.slow
def test_a_killed_bake_goes_on(active: Dataset, tmp_path: Path) -> None:
    """Killed by the system at several moments; the end is the same to the bit."""
    config, folder = tmp_path / "config.toml", tmp_path / "run"
    config.write_text(small().to_toml())
    command = [sys.executable, "-m", "ddprt", "bake", str(config), "--out", str(folder), "--quiet"]
    seen = tmp_path / "run" / "dataset"
    for wanted in ("direct/000002.exr", "indirect/000001.exr"):
        process = subprocess.Popen(command, env={**os.environ}, stdout=subprocess.DEVNULL)
        while process.poll() is None and not (seen / wanted).exists():
            time.sleep(0.005)
        process.send_signal(signal.SIGKILL)
        process.wait()
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    done = open_dataset(seen)
    assert done.description == active.description
    for kind in ("direct", "indirect"):
        np.testing.assert_array_equal(done.maps(kind, range(9)), active.maps(kind, range(9)))


GROWING = {"train": FIRST_GROUP + 2, "candidates": 2, "region_low": [0.2, 0.5, 0.2], "region_high": [0.8, 0.8, 0.8]}


def test_groups_double() -> None:
    assert group_sizes(100) == [16, 32, 64, 100]
    assert group_sizes(64) == [16, 32, 64]
    assert group_sizes(7) == [7]


@pytest.fixture(scope="module")
def stopped(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("stopped")
    run = Run(small(lightings={**GROWING, "target_error": 5.0}), folder, quiet=True)
    run.bake()
    run.record(run.dataset())
    assert [stage["name"] for stage in run.progress.stages].count("fit 16 lightings") == 2
    return folder


def test_a_bake_stops_at_its_target(stopped: Path, cornell: Scene) -> None:
    data = open_dataset(stopped / "dataset")
    assert len(data.split("train")) == FIRST_GROUP
    assert sorted(path.name for path in stopped.iterdir()) == ["config.toml", "dataset", "run.json"]
    at_once = bake(cornell, config=small(lightings={**GROWING, "target_error": 5.0}), first=FIRST_GROUP)
    assert at_once.description == data.description
    everything = range(FIRST_GROUP + 4)
    np.testing.assert_array_equal(at_once.maps("indirect", everything), data.maps("indirect", everything))


def test_a_stopped_bake_is_found_finished(stopped: Path, tmp_path: Path) -> None:
    folder = shutil.copytree(stopped, tmp_path / "run")
    run = Run(small(lightings={**GROWING, "target_error": 5.0}), folder, quiet=True)
    before = (folder / "dataset" / "manifest.jsonl").read_bytes()
    assert len(run.bake().split("train")) == FIRST_GROUP
    assert (folder / "dataset" / "manifest.jsonl").read_bytes() == before
    assert run.dataset().lightings
    tighter = Run(small(lightings={**GROWING, "target_error": 1e-6}), folder, quiet=True)
    with pytest.raises(UserError, match=r"holds 16 training lightings with a validation error of .* expected at most 1e-06"):
        tighter.bake()


class _Listening(Progress):
    """Keeps warnings, and how many rays had been traced when each stage began and ended."""

    def __init__(self, lines: list[str], traced: Callable[[], int]) -> None:
        super().__init__(quiet=True)
        self.lines, self.traced, self.rays = lines, traced, dict[str, list[int]]()

    def warn(self, line: str) -> None:
        self.lines.append(line)

    @contextmanager
    def stage(self, name: str, total: int = 0) -> Iterator[Stage]:
        before = self.traced()
        with super().stage(name, total) as stage:
            yield stage
        self.rays.setdefault(name, []).append(self.traced() - before)


@pytest.fixture
def counted(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Rays that all tracers have traced so far."""
    total, count = [0], Tracer._count

    def counting(tracer: Tracer, rays: int) -> None:
        count(tracer, rays)
        total[0] += rays

    monkeypatch.setattr(Tracer, "_count", counting)
    return total


def test_a_target_out_of_reach_bakes_all_says_so_and_goes_on(
    cornell: Scene, counted: list[int], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Stopped once 16 were found too few; the second run, too, draws and measures candidates once for both its bakes."""
    config, told = small(lightings={**GROWING, "target_error": 1e-6}, points={"choose": "qr"}), pipeline_active._told

    def stopped_later(data: Dataset, *rest: Any) -> float:
        told(data, *rest)
        raise KeyboardInterrupt

    spent = []
    for last in (False, True):
        run, lines = Run(config, tmp_path / "run", quiet=True), list[str]()
        run.progress = progress = _Listening(lines, lambda: counted[0])
        with monkeypatch.context() as patch, nullcontext() if last else pytest.raises(KeyboardInterrupt):
            if not last:
                patch.setattr(pipeline_active, "_told", stopped_later)
            data = run.bake()
        spent.append({name: progress.rays[name] for name in ("lightings", "points", "choose")})
    first, second = spent
    assert [len(rays) for rays in first.values()] == [1, 1, 1]
    for name, rays in second.items():
        assert len(rays) == 2
        assert rays[0] == first[name][0] > 0, "nothing is left of what a stopped run had measured"
    assert second["lightings"][1] == second["points"][1] == 0
    most = SMALL["points"]["count"] * SMALL["points"]["supersample"] * (FIRST_GROUP + 2)  # one shadow ray each, or none
    assert 0 < second["choose"][1] <= most < second["choose"][0], "of the second, only for its points"
    assert len(data.split("train")) == FIRST_GROUP + 2
    assert any("with all 18 training lightings, expected at most 1e-06" in line for line in lines)
    at_once = bake(cornell, config=config, first=FIRST_GROUP + 2)
    assert at_once.description == data.description
    np.testing.assert_array_equal(at_once.maps("indirect", range(22)), data.maps("indirect", range(22)))


def test_steps_are_shared_by_bakes_of_the_same_alone(cornell: Scene) -> None:
    once = Once()
    bake(cornell, config=small(), first=1, once=once)
    with pytest.raises(ValueError, match="got another scene or other settings"):
        bake(cornell, config=small(points={"count": 7}), first=1, once=once)


ONE = [(PointLight(position=(0.3, 0.4, 0.3), intensity=(1, 1, 1)),)] * 4
BAD: list[tuple[dict[str, Any], dict[str, Any], str]] = [
    ({"lightings": {"file": "lamps.json"}}, {}, "lightings.choose: got .active. beside lightings.file lamps.json"),
    ({"lightings": {"choose": "random", "target_error": 0.1}}, {}, "lightings.target_error: got 0.1 beside .*random"),
    ({"lightings": {"target_error": 0.1}}, {}, "lightings.target_error: got 0.1, but a bake by itself fits nothing"),
    ({"lightings": {"choose": "random"}}, {"first": 2}, "first: got 2, expected 1 to 5 with .*active"),
    ({}, {"first": 0}, "first: got 0, expected 1 to 5"),
    ({}, {"first": 6}, "first: got 6, expected 1 to 5"),
    ({"points": {"choose": "qr", "file": "points.json"}}, {}, "points.choose: got .qr. beside points.file points.json"),
    ({}, {"lightings": ONE}, "lightings: got a list beside lightings.choose"),
    ({}, {"lightings": "passive"}, 'bake: got lightings "passive", expected'),
]


@pytest.mark.parametrize(("changes", "arguments", "message"), BAD)
def test_bad_input_is_one_line(cornell: Scene, changes: dict[str, Any], arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(UserError, match=message) as caught:
        bake(cornell, config=small(**changes), **arguments)
    assert "\n" not in str(caught.value)


def test_a_random_bake_knows_nothing_of_choices(cornell: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    """Lightings and points are as drawn and placed, and nothing of the choice is called."""
    for name in ("choose_rows", "choose_columns"):
        monkeypatch.setattr(f"ddprt.dataset.splits.{name}", None)
    config = small(lightings={"choose": "random"})
    data = bake(cornell, config=config)
    clearance = Tracer.of(cornell, 1).clearance
    drawn = draw_lightings(config.lightings, "train", 5, bounds=cornell.bounds, clearance=clearance, seed=0)
    assert data.lightings[:5] == drawn.lightings
    assert "candidates" not in data.description["drawn"]
    atlas, _ = build_open_atlas(Tracer.of(cornell), cornell, 24)
    placed = place_samples(cornell, 16, on="surface", seed=0, atlas=atlas)
    assert data.samples.digest == replace(placed, depth=data.samples.depth).digest
