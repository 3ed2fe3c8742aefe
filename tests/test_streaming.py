"""Fits of light that stays on disk: the bits of the fit in memory, in memory that does not grow with the texels.

Both walk through the same tiles in the same order, and encoding works on each value alone, so that equality is exact. What
is summed over the blocks themselves (the sketch that trust is made from, squares of the validation lightings) differs by
rounding; bounds stand beside.
"""

import gc
import itertools
import json
import os
import subprocess
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ddprt import cli
from ddprt.config import load_config
from ddprt.dataset.generate import bake
from ddprt.dataset.store import Dataset
from ddprt.errors import UserError
from ddprt.fitting import basis as bases
from ddprt.fitting.basis import Basis, fit_basis
from ddprt.fitting.encoding import Encoding
from ddprt.methods.method import Maps, found_in, in_memory
from ddprt.runtime import train, trust
from ddprt.runtime.model import Model
from ddprt.scene.mesh import Scene
from ddprt.sections import FitConfig

EPS = float(np.finfo(np.float32).eps)


@pytest.fixture(scope="module")
def data(cornell: Scene, tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    """A box of 5128 texels or so: with 8 lightings, six tiles of which the last is not whole."""
    out = tmp_path_factory.mktemp("streaming") / "dataset"
    few = {"lightings.train": "8", "lightings.validation": "4", "lightings.test": "2"}
    few |= {"transport.samples": "16", "transport.test_samples": "16"}
    config = load_config(None, {"atlas.resolution": "80", "points.count": "24", "points.supersample": "1", **few})
    return bake(cornell, config=config, out=out)


@pytest.fixture
def small_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    """Blocks of one tile, where 32 MiB would hold all."""
    monkeypatch.setattr(bases, "_BLOCK", 1)


def fitted(data: Dataset, stream: bool, **settings: object) -> Model:
    config = FitConfig.model_validate({"bases": 6, **settings})
    return train.fit_method(data, config, "svd-ridge", {}, points=None, quantity="radiosity", seed=0, stream=stream)


def slow_unless(fast: Sequence[tuple[object, ...]], *choices: Sequence[object]) -> list[Any]:
    """All combinations, of which few are tried each time."""
    return [pytest.param(*one, marks=[] if one in fast else [pytest.mark.slow]) for one in itertools.product(*choices)]


WAYS = slow_unless([("gamma", "multi", "mean")], ["linear", "gamma"], ["mono", "multi"], ["none", "mean"])


@pytest.mark.usefixtures("small_blocks")
@pytest.mark.parametrize(("space", "channels", "centre"), WAYS)
def test_a_streamed_fit_is_the_fit_in_memory(data: Dataset, space: str, channels: str, centre: str) -> None:
    held, streamed = (fitted(data, way, space=space, channels=channels, centre=centre) for way in (False, True))
    assert streamed.relighter.report == held.relighter.report
    for one, other in zip(*(jax.tree_util.tree_leaves(m.relighter) for m in (held, streamed)), strict=True):
        np.testing.assert_array_equal(np.asarray(one), np.asarray(other))
    ours, theirs = (m.yardstick for m in (held, streamed))
    assert ours is not None
    assert theirs is not None
    # Directions hang on the measurements alone; the ridge is chosen on a grid, from sketches good to rounding.
    np.testing.assert_array_equal(ours.directions, theirs.directions)
    assert theirs.ridge == ours.ridge
    # The logarithm of an error of e moves by at most its rounding over e; of sums of T squares, eps sqrt(T) and more is room.
    assert theirs.exponent == pytest.approx(ours.exponent, abs=EPS * np.sqrt(data.covered.sum()) / 1e-2)


@pytest.mark.usefixtures("small_blocks")
def test_a_streamed_fit_holds_no_light(data: Dataset, monkeypatch: pytest.MonkeyPatch) -> None:
    """It never asks for whole maps, and no block is larger than it should be."""
    sizes: list[tuple[int, ...]] = []
    kept = train.StreamedMaps._encode

    def encode(self: train.StreamedMaps, light: np.ndarray, scale: jax.Array) -> jax.Array:
        sizes.append(light.shape)
        return kept(self, light, scale)

    monkeypatch.setattr(train.StreamedMaps, "_encode", encode)
    monkeypatch.setattr(Dataset, "maps", None)
    fitted(data, True)
    texels = int(data.covered.sum())
    assert {size for size in sizes if size[0] == 8} == {(8, 1024, 3), (8, texels % 1024, 3)}
    assert {size for size in sizes if size[0] != 8} == {(1, texels, 3)}


@pytest.mark.usefixtures("small_blocks")
def test_the_sketch_of_a_stream_is_that_of_the_whole(data: Dataset) -> None:
    encoding, config = Encoding(), FitConfig()
    pack = data.packed()
    for channels in ("mono", "multi"):
        config = FitConfig(channels=channels)
        held, streamed = (train.examples(data, "train", encoding, config, 24, "radiosity", p) for p in (None, pack))
        assert isinstance(streamed.indirect, Maps)
        np.testing.assert_array_equal(np.asarray(in_memory(streamed.indirect)), np.asarray(held.indirect))
        ours, theirs = (trust._sketched(one) for one in (held, streamed))
        # A sum of n float32 products in any order is off by n eps / 2 of the sum of their magnitudes at the most.
        entries = bases.entry_weights(held.area, held.weights, held.channels)  # type: ignore[arg-type]
        light = np.abs(np.asarray(held.indirect))
        size = np.einsum("lec,e->cl", light if channels == "mono" else light.reshape(8, -1, 1), np.sqrt(entries / 16))
        assert (np.abs(ours - theirs) <= len(entries) * EPS * size[..., None]).all()
        assert ours.any()


class Sliced:
    """Columns in memory that come as from disk, in blocks of some tiles."""

    def __init__(self, columns: np.ndarray, tiles: int) -> None:
        self.columns, self.tiles = columns, tiles

    @property
    def shape(self) -> tuple[int, int]:
        return self.columns.shape

    def blocks(self) -> Iterator[jax.Array]:
        size = self.tiles * bases._TILE
        for start in range(0, self.columns.shape[1], size):
            yield jnp.asarray(self.columns[:, start : start + size])


def deep(columns: int, entries: int, depth: float) -> np.ndarray:
    rng = np.random.default_rng(columns)
    strengths = np.geomspace(1, depth, 20)
    return (rng.standard_normal((columns, 20)) * strengths @ rng.standard_normal((20, entries))).astype(np.float32)


BLOCKS = slow_unless(
    [(4 * 1024 + 77, 1e-8, True)],
    [5 * 1024, 4 * 1024 + 77, 900],
    [1e-2, 1e-8],
    [False, True],
)


@pytest.mark.parametrize(("entries", "depth", "centre"), BLOCKS)
def test_blocks_do_not_change_a_bit(entries: int, depth: float, centre: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    columns = deep(40, entries, depth)
    weights = jnp.asarray(np.random.default_rng(1).random(entries, np.float32) / entries)
    asked: list[Basis] = [fit_basis(jnp.asarray(columns), weights, bases=16, centre=centre)]
    assert (bases._deep(np.asarray(asked[0].singular_values)) is not None) == (depth < 1e-7)
    asked += [fit_basis(Sliced(columns, tiles), weights, bases=16, centre=centre) for tiles in (2, 9)]
    monkeypatch.setattr(bases, "_BLOCK", 3 * 1024 * 40 * 4)
    asked.append(fit_basis(jnp.asarray(columns), weights, bases=16, centre=centre))
    for other in asked[1:]:
        for name in ("vectors", "mean", "coefficients", "singular_values", "rank", "status"):
            np.testing.assert_array_equal(*(np.asarray(getattr(one, name)) for one in (asked[0], other)), err_msg=name)


def test_an_empty_or_odd_stream_is_told_as_in_memory() -> None:
    columns = deep(5, 2100, 1e-2)
    weights = jnp.ones(2100)
    assert fit_basis(Sliced(0 * columns, 1), weights, bases=3).status == "no_signal"
    assert fit_basis(Sliced(columns[:0], 1), weights, bases=3).status == "no_signal"
    columns[2, 2050] = np.nan
    with pytest.raises(ValueError, match="got NaN"):
        fit_basis(Sliced(columns, 1), weights, bases=3)


@pytest.mark.usefixtures("small_blocks")
def test_dark_lightings_and_black_light(data: Dataset) -> None:
    """A lighting that no point sees is told by its share of the light; light that is black altogether is told too."""
    encoding, pack = Encoding(), data.packed()
    assert pack is not None
    held, streamed = (train.examples(data, "train", encoding, FitConfig(), 24, "radiosity", p) for p in (None, pack))
    assert found_in(held) == found_in(streamed) == set()
    scale = streamed.scale.at[2].set(0)
    maps = train.StreamedMaps(pack, tuple(data.split("train")), encoding, scale)
    rows, size = train_columns(streamed, maps, scale)
    assert rows == (21, pack.texels)
    assert size == 21
    nothing = train.StreamedMaps(pack, tuple(data.split("train")), encoding, jnp.zeros_like(scale))
    assert found_in(train.replace(streamed, indirect=nothing)) == {"no_signal"}


def train_columns(examples: train.Examples, maps: Maps, scale: jax.Array) -> tuple[tuple[int, int], int]:
    from ddprt.methods.method import columns

    rows, size = columns(train.replace(examples, indirect=maps, scale=scale))
    assert {len(block) for block in rows.blocks()} == {len(size)}  # type: ignore[union-attr]
    return rows.shape, len(size)


def test_what_is_large_for_the_memory_is_streamed(data: Dataset, monkeypatch: pytest.MonkeyPatch) -> None:
    from ddprt.methods import make_method

    size = 12 * len(data.area) * 12
    ridge, nearest = (
        make_method(name, FitConfig().model_dump(exclude={"method", "points"}), {}) for name in ("svd-ridge", "nearest")
    )
    for share, streams in ((0.24, False), (0.26, True)):
        monkeypatch.setattr(train, "_free_memory", lambda share=share: int(size / share))
        assert (train._streamed(data, ridge, "svd-ridge", None) is not None) == streams
        assert train._streamed(data, nearest, "nearest", None) is None
    monkeypatch.setattr(train, "_free_memory", lambda: 2 * size - 1)
    assert train._streamed(data, ridge, "svd-ridge", None) is not None
    with pytest.raises(UserError, match=r"nearest: got .* GiB of light that it holds twice"):
        train._streamed(data, nearest, "nearest", None)
    with pytest.raises(UserError, match="stream: got true for nearest"):
        train._streamed(data, nearest, "nearest", True)
    monkeypatch.setattr(train, "_free_memory", lambda: None)
    assert train._streamed(data, ridge, "svd-ridge", None) is None


def test_free_memory_is_some(data: Dataset) -> None:
    free = train._free_memory()
    assert free is None or 2**20 < free < 2**50


PEAK = """
import sys
from pathlib import Path
sys.path.insert(0, {experiments!r})
import streaming
from ddprt.fitting import basis
basis._BLOCK = {block}
path, texels = Path(sys.argv[1]), int(sys.argv[2])
streaming.child(path, texels, "streamed")
"""


@pytest.mark.slow
def test_memory_does_not_grow_with_the_light(tmp_path: Path) -> None:
    """Peak of a streamed fit of 60 000 texels x 128 lightings, blocks of 4 MiB, in a process of its own.

    Held at once, at the most: the block that is read and the next one, its encoded light and rows, one of them twice where it
    is copied to JAX (6 blocks), vectors in float64 and twice in float32 (16 x T x 16 B), a tile of 384 columns in float64 a few
    times and matrices of 384 x 384 (under 32 MiB). The data itself, were it held, would come to 88 MiB each time: with its rows
    and their encoding more than twice that.
    """
    experiments = Path(__file__).parent.parent / "experiments"
    sys.path.insert(0, str(experiments))
    try:
        import streaming
    finally:
        sys.path.remove(str(experiments))
    texels, block = 60_000, 2**22
    path = tmp_path / "indirect.f16"
    streaming.write(path, texels)
    code = PEAK.format(experiments=str(experiments), block=block)
    answer = subprocess.run([sys.executable, "-c", code, str(path), str(texels)], capture_output=True, text=True, check=True)
    peak = json.loads(answer.stdout.splitlines()[-1])["peak_gib"]
    gc.collect()
    if peak is None:
        pytest.skip("this system does not tell the peak")
    bound = 6 * block + 16 * texels * 16 + 2**25
    assert bound < 12 * texels * 128, "a fit that held its data would pass too"
    assert peak * 2**30 < bound


COMPILED = """
import os, sys
sys.argv = ["ddprt", "--version"]
from ddprt import cli
assert "jax" not in sys.modules
cli._keep_compiled()
assert "jax" not in sys.modules
from ddprt.bench.measure.timing import compiling
import jax, jax.numpy as jnp
with compiling() as spent:
    x = jax.block_until_ready(jax.jit(lambda x: jnp.linalg.svd(jnp.sin(x) @ x.T + jnp.cumsum(x, 1))[1])(jnp.ones((9, 9))))
print(spent[0], x.tobytes().hex() if hasattr(x, "tobytes") else bytes(x).hex())
"""


def test_a_second_command_finds_what_the_first_compiled(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DDPRT_CACHE", str(tmp_path / "cache"))
    for name in ("JAX_COMPILATION_CACHE_DIR", "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"):
        monkeypatch.delenv(name, raising=False)
    run = lambda: subprocess.run([sys.executable, "-c", COMPILED], capture_output=True, text=True, check=True)  # noqa: E731
    first = run()
    files = {path.name: path.stat().st_mtime_ns for path in (tmp_path / "cache").glob("jax-*/*-cache")}
    assert files
    second = run()
    assert {path.name: path.stat().st_mtime_ns for path in (tmp_path / "cache").glob("jax-*/*-cache")} == files
    assert not second.stderr
    assert first.stdout.split()[1] == second.stdout.split()[1]  # the same bits
    assert float(second.stdout.split()[0]) < float(first.stdout.split()[0])
    for path in (tmp_path / "cache").glob("jax-*/*-cache"):
        os.truncate(path, path.stat().st_size // 2)
    cut = run()  # as a killed command leaves them: JAX says so, and compiles again
    assert "Error reading persistent compilation cache entry" in cut.stderr
    assert cut.stdout.split()[1] == first.stdout.split()[1]


def test_a_cache_that_cannot_be_written_costs_time_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("DDPRT_CACHE", str(tmp_path / "file" / "cache"))
    monkeypatch.delenv("JAX_COMPILATION_CACHE_DIR", raising=False)
    monkeypatch.delitem(sys.modules, "jax")
    cli._keep_compiled()
    assert "JAX_COMPILATION_CACHE_DIR" not in os.environ
