"""Files of textures hold what they say, read by other means than those that wrote them, and their transfers fit them."""

import json
import re
import struct
import sys
import typing
import zlib
from collections.abc import Callable
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import OpenEXR
import pytest
from PIL import Image
from small_job import SMALL, call

from ddprt.config import checked
from ddprt.errors import UserError
from ddprt.export.formats.bc6h import encode_bc6h, write_dds
from ddprt.export.formats.bc6h_decode import decode_bc6h
from ddprt.export.formats.format import Maps, layered, ranges, unlayered
from ddprt.export.formats.ktx2 import BC6H, RGBA16F, read_ktx2, write_ktx2
from ddprt.export.formats.listing import FORMATS
from ddprt.export.formats.png import read_png, write_png
from ddprt.export.refit import Stock, transfer_for
from ddprt.export.stored import as_seen, weights_of, write_format
from ddprt.export.table import HeldOut, as_json, format_table, told
from ddprt.export.textures import export_textures, textures
from ddprt.files import read_tensors
from ddprt.fitting.encoding import Encoding
from ddprt.methods.svd_ridge import LinearTransfer
from ddprt.runtime.model import Model
from ddprt.sampling.points import Samples

DOCS = Path(__file__).parent.parent / "docs" / "export.md"
HEIGHT, WIDTH, POINTS, BASES = 16, 24, 10, 6
OPTIONS: list[dict[str, Any]] = [{"centre": "mean"}, {"channels": "multi", "centre": "mean", "space": "gamma"}]
ERROR = {"exr-grid": 1e-3, "raw": 1e-3, "ktx2": 1e-3, "bytes": 0.02, "bc6h": 0.1, "bc6h-ktx2": 0.1}
"""Of a frame, norm over norm: eleven bits, eight, and what lines of colours leave of six smooth maps with edges."""

needs_encoder = pytest.mark.skipif(find_spec("ispc_texcomp") is None, reason="ispc-texcomp is not installed")
WRITTEN = [pytest.param(name, marks=needs_encoder if name.startswith("bc6h") else []) for name in FORMATS if name != "exr"]


def lamps() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Smooth light on two charts that fill an uneven part of the atlas, unlike in every direction.

    Returns:
      Covered texels, (20, points, 3) measured light and (20, texels, 3) maps.
    """
    rng = np.random.default_rng(3)
    covered = np.zeros((HEIGHT, WIDTH), bool)
    covered[1:11, 2:13], covered[3:14, 16:23] = True, True
    row, column = np.nonzero(covered)
    places, texels = rng.uniform(-4, 28, (20, 2)), np.stack([row, column], 1)
    falloff = 1 / (20 + ((texels - places[:, None]) ** 2).sum(2))[..., None] * [4.0, 2.0, 1.0]
    maps = falloff**0.7 * (1 + 0.2 * np.sin(row[:, None] / 3 + np.arange(3)))
    return covered, falloff[:, :: len(row) // POINTS][:, :POINTS].astype(np.float32), maps.astype(np.float32)


def learned(space: Any = "linear", channels: Any = "mono", centre: str = "none") -> Model:
    """A model by an SVD and a pseudo-inverse in NumPy: no fit is compiled for these tests."""
    covered, measured, maps = lamps()
    mono = channels == "mono"
    scale = np.linalg.norm(measured, axis=1 if mono else (1, 2), keepdims=True)
    z, y = ((part / scale) ** (1 / 2.2 if space == "gamma" else 1) for part in (measured, maps))
    z, y = ((np.moveaxis(part, 2, 0) if mono else part.reshape(1, 20, -1)) for part in (z, y))
    mean = y.mean((0, 1)) * (centre == "mean")
    basis = np.linalg.svd((y - mean).reshape(-1, y.shape[2]), full_matrices=False)[2][:BASES]
    offset = z.mean(1, keepdims=True) * (centre == "mean")
    matrix = np.swapaxes(np.linalg.pinv(z - offset, rcond=1e-2) @ ((y - mean) @ basis.T), 1, 2)
    parts = matrix, offset[:, 0], np.full((len(z), BASES), 0.01), basis, mean
    return Model(
        "svd-ridge",
        LinearTransfer(*(jnp.asarray(part, jnp.float32) for part in parts)),
        Encoding(space, 2.2, channels),
        Samples(
            np.linspace(0, 1, 3 * POINTS).reshape(POINTS, 3), np.tile([0.0, 1.0, 0.0], (POINTS, 1)), np.ones((POINTS, 3)), 0.1
        ),
        POINTS,
        "radiosity",
        covered,
        np.linspace(1, 2, maps.shape[1]).astype(np.float32),
        np.zeros((1, 3, 3)),
        {"name": "two charts", "digest": "0"},
    )


@pytest.fixture(scope="module", params=OPTIONS, ids=str)
def model(request: pytest.FixtureRequest) -> Model:
    return learned(**request.param)


@pytest.fixture(scope="module")
def plain() -> Model:
    return learned()


def documented() -> dict[str, Any]:
    """The blocks of docs/export.md that decode, executed."""
    scope: dict[str, Any] = {}
    blocks = re.findall(r"```python\n(.*?)```", DOCS.read_text(), re.DOTALL)
    for block in (block for block in blocks if "def decode" in block):
        exec(block, scope)
    return scope


def frames() -> np.ndarray:
    """Some of the measured light."""
    return lamps()[1][:3]


@pytest.mark.parametrize("name", WRITTEN)
def test_documented_decoder_answers_as_the_model(name: str, model: Model, tmp_path: Path) -> None:
    written = export_textures(model, tmp_path, formats=[name])
    assert {path.name for path in written} == {path.name for path in tmp_path.iterdir()}
    entry = json.loads((tmp_path / "manifest.json").read_text())["formats"][name]
    assert entry["bytes"] == sum((tmp_path / file).stat().st_size for file in (*entry["files"], entry["transfer"]))
    seen = as_seen(model, textures(model)[0], name, tmp_path, entry)
    decode = documented()["decode_format"]
    for values in frames():
        got, exact = decode(tmp_path, name, values)[model.covered], model.predict(values)
        np.testing.assert_allclose(got, seen.predict(values), rtol=1e-3, atol=1e-4 * exact.max())
        assert np.linalg.norm(got - exact) < ERROR[name] * np.linalg.norm(exact)


def marked(model: Model) -> Model:
    """Bases that are unlike at every texel: basis b is (b + 1) times place, the odd ones negative."""
    place = np.flatnonzero(model.covered.ravel()).astype(np.float32)
    rows = np.stack([(-1) ** b * (b + 1) * (place + 7 * b) for b in range(BASES)])
    return replace(model, relighter=replace(model.relighter, basis=jnp.asarray(rows, jnp.float32)))


PLACES = [(1, 2), (10, 12), (3, 16), (13, 22), (5, 9)]


def value(b: int, row: int, column: int) -> float:
    return float((-1) ** b * (b + 1) * (row * WIDTH + column + 7 * b))


def in_raw(folder: Path, entry: dict, b: int, row: int, column: int) -> float:
    data = (folder / "basis.rgba16f").read_bytes()
    at = entry["offsets"][b // 4] + 8 * (row * WIDTH + column) + 2 * (b % 4)
    return float(struct.unpack_from("<e", data, at)[0])


def in_ktx2(folder: Path, entry: dict, b: int, row: int, column: int) -> float:
    data = (folder / "basis.ktx2").read_bytes()
    assert struct.unpack_from("<3I", data, 12)[0] == 97
    assert struct.unpack_from("<6I", data, 20) == (WIDTH, HEIGHT, 0, 2, 1, 1)
    (at,) = struct.unpack_from("<Q", data, 80)
    at += (b // 4) * 8 * WIDTH * HEIGHT + 8 * (row * WIDTH + column) + 2 * (b % 4)
    return float(struct.unpack_from("<e", data, at)[0])


def in_bytes(folder: Path, entry: dict, b: int, row: int, column: int) -> float:
    with Image.open(folder / f"basis_{b // 4:02d}.png") as picture:
        assert picture.mode == "RGBA"
        return picture.getpixel((column, row))[b % 4] / 255


def in_grid(folder: Path, entry: dict, b: int, row: int, column: int) -> float:
    assert (entry["columns"], entry["rows"]) == (2, 1)
    with OpenEXR.File(str(folder / "basis-grid.exr")) as file:
        return float(file.channels()["RGBA"].pixels[row, WIDTH * (b // 4) + column, b % 4])


READERS: dict[str, tuple[Callable[..., float], float]] = {
    "raw": (in_raw, 2**-11),
    "ktx2": (in_ktx2, 2**-11),
    "bytes": (in_bytes, 0.51 / 255),
    "exr-grid": (in_grid, 2**-11),
}


@pytest.mark.parametrize("name", READERS)
def test_files_are_the_right_way_up_for_other_readers(name: str, plain: Model, tmp_path: Path) -> None:
    export_textures(marked(plain), tmp_path, formats=[name], gutter=0)
    entry = json.loads((tmp_path / "manifest.json").read_text())["formats"][name]
    read, step = READERS[name]
    for b in range(BASES):
        for row, column in PLACES:
            t, scale, bias = read(tmp_path, entry, b, row, column), entry["scale"][b], entry["bias"][b]
            assert abs(scale * t + bias - value(b, row, column)) <= step * scale + 1e-4 * scale


@needs_encoder
def test_bc6h_is_the_right_way_up_for_pillow(tmp_path: Path) -> None:
    row, column = np.indices((HEIGHT, WIDTH))
    grey = 0.5 + 0.5 * (2 * row + column) / (2 * HEIGHT + WIDTH)
    image = (grey[..., None] * [1.0, 0.9, 0.8]).astype(np.float32)
    write_dds(tmp_path / "a.dds", HEIGHT, WIDTH, 1, encode_bc6h(image[None]))
    with Image.open(tmp_path / "a.dds") as picture:
        assert picture.size == (WIDTH, HEIGHT)
        np.testing.assert_allclose(np.asarray(picture) / 255, image, atol=0.01)


MODES = (0b00, 0b01, *(high << 2 | low for low in (2, 3) for high in range(8)))


def blocks_of(modes: tuple[int, ...], each: int) -> np.ndarray:
    """Random blocks whose first bits are those of the modes."""
    blocks = np.random.default_rng(6).integers(0, 256, (len(modes), each, 16), dtype=np.uint8)
    for mode, some in zip(modes, blocks, strict=True):
        keep = 0b11 if mode < 2 else 0b11111
        some[:, 0] = some[:, 0] & ~np.uint8(keep) | mode
    return blocks.reshape(-1, 16)


def test_bc6h_of_every_mode_as_pillow_reads_it(tmp_path: Path) -> None:
    """Pillow gives 8 bits, rounded down, cut off at 1; its lines are a step of halves off here and there.

    Half of the random values lie below 1, over eight binary orders.
    """
    blocks = blocks_of(MODES, 64)
    side = (4 * 64, 4 * len(MODES))
    write_dds(tmp_path / "a.dds", side[1], side[0], 1, blocks.tobytes())
    with Image.open(tmp_path / "a.dds") as picture:
        theirs = np.asarray(picture).astype(float)
    ours = 255 * np.minimum(decode_bc6h(blocks.tobytes(), side[1], side[0]), 1)
    assert 0.3 < np.mean(ours < 255) < 0.7
    assert np.abs(ours - theirs).max() <= 1 + 255 * 2**-11


def test_bc6h_bit_by_bit() -> None:
    """A digest of what another decoder, which keeps all bits, made of the same blocks: imagecodecs 2026.3."""
    decoded = decode_bc6h(blocks_of(MODES, 64).tobytes(), 4 * len(MODES), 4 * 64)
    assert zlib.crc32(decoded.astype("<f2").tobytes()) == 3360999983


@needs_encoder
def test_bc6h_of_smooth_light_is_near_it() -> None:
    x = np.linspace(0, 1, 32)
    image = 1 + 0.5 * np.stack([x[:, None] * x, x[:, None] + 0 * x, np.cos(x[:, None] - x)], 2).astype(np.float32)
    back = decode_bc6h(encode_bc6h(image[None]), 32, 32)
    assert np.abs(back - image).max() < 0.02


def made_up(groups: int, mean: bool, seed: int) -> tuple[LinearTransfer, Stock]:
    """A transfer, and textures that were rounded coarsely."""
    rng = np.random.default_rng(seed)
    maps = rng.normal(size=(4 + mean, 31)).astype(np.float32)
    matrix, offset, intercept = rng.normal(size=(groups, 4, 5)), rng.normal(size=(groups, 5)), rng.normal(size=(groups, 4))
    parts = matrix, offset, intercept, maps[:4], maps[4] if mean else 0 * maps[0]
    arrays = [jnp.asarray(part, jnp.float32) for part in parts]
    scale = np.full(len(maps), 0.8, np.float32)
    bias = rng.normal(size=len(maps)).astype(np.float32)
    stored = np.rint((maps - bias[:, None]) / scale[:, None]).astype(np.float32)
    return LinearTransfer(*arrays), Stock(maps, stored, scale, bias, rng.uniform(0.1, 3, 31))


def distances(relighter: LinearTransfer, stock: Stock, transfer: Any) -> tuple[np.ndarray, np.ndarray]:
    """Weighted squares of the error and of the answer, for no measurement and for each alone, (groups, 1 + inputs)."""
    z = np.concatenate([np.zeros((1, 5)), np.eye(5)])
    has_mean = len(stock.maps) > 4
    found = np.zeros((2, len(transfer.matrix), len(z)))
    for group in range(len(transfer.matrix)):
        for k, frame in enumerate(z):
            # What adds to the light without any measurement: offsets stay out of the comparison.
            u = np.asarray(relighter.matrix[group]) @ frame + (k == 0) * np.asarray(relighter.intercept[group])
            y = u @ stock.maps[:4] + ((k == 0) * stock.maps[4] if has_mean else 0)
            v = transfer.matrix[group] @ frame + (k == 0) * transfer.intercept[group]
            seen = v[:-1] @ stock.stored + v[-1]
            found[:, group, k] = stock.weights @ (seen - y) ** 2, stock.weights @ y**2
    return found[0], found[1]


@pytest.mark.parametrize(("groups", "mean"), [(3, False), (3, True), (1, True)])
def test_fitting_anew_is_least_squares(groups: int, mean: bool) -> None:
    """As `numpy.linalg.lstsq` has it for each measurement alone; never worse than the old coefficients; told as it is."""
    for seed in range(5):
        relighter, stock = made_up(groups, mean, seed)
        kept, refitted = (transfer_for(relighter, stock, refit=refit) for refit in (False, True))
        (old, whole), (new, _) = distances(relighter, stock, kept), distances(relighter, stock, refitted)
        assert (new <= old * (1 + 1e-5)).all()
        assert new.sum() < 0.9 * old.sum()
        np.testing.assert_allclose(refitted.kept, np.sqrt(old.sum() / whole.sum()), rtol=1e-4)
        np.testing.assert_allclose(refitted.refitted, np.sqrt(new.sum() / whole.sum()), rtol=1e-4)
        assert kept.refitted == kept.kept == refitted.kept
        assert refitted.rank == 4
        seen = stock.stored * stock.scale[:, None] + stock.bias[:, None]
        root = np.sqrt(stock.weights)
        for group in range(groups):
            for k in range(5):
                y = np.asarray(relighter.matrix)[group, :, k] @ stock.maps[:4]
                best = np.linalg.lstsq((seen[:4] * root).T, y * root, rcond=None)[0]
                np.testing.assert_allclose(refitted.matrix[group, :4, k], best * stock.scale[:4], rtol=1e-3, atol=1e-4)


def test_exact_textures_keep_their_transfer() -> None:
    relighter, stock = made_up(3, True, 0)
    same = replace(stock, stored=stock.maps, scale=np.ones(5, np.float32), bias=np.zeros(5, np.float32))
    found = transfer_for(relighter, same)
    np.testing.assert_allclose(found.matrix[:, :4], relighter.matrix, atol=1e-5)
    expected = np.concatenate([relighter.intercept, np.ones((3, 1)), np.zeros((3, 1))], 1)
    np.testing.assert_allclose(found.intercept, expected, atol=1e-5)
    assert found.refitted < 1e-7


def test_textures_that_rounding_made_alike_or_nothing() -> None:
    relighter, stock = made_up(3, False, 1)
    stored = stock.stored.copy()
    stored[1], stored[2] = stored[0], 0
    poor = replace(stock, stored=stored, bias=np.zeros(4, np.float32))
    found = transfer_for(relighter, poor)
    assert found.rank == 2
    assert np.isfinite(found.matrix).all()
    assert found.refitted <= found.kept
    bad = replace(stock, stored=np.full_like(stored, np.nan))
    with pytest.raises(ValueError, match="textures that are not finite"):
        transfer_for(relighter, bad)


def test_means_past_the_range_of_halves_are_scaled(tmp_path: Path) -> None:
    model = learned(centre="mean")
    bright = replace(model, relighter=replace(model.relighter, mean=1e7 * model.relighter.mean))
    for name in ("raw", "ktx2", "exr-grid", "bytes"):
        export_textures(bright, tmp_path / name, formats=[name])
        decoded = documented()["decode_format"](tmp_path / name, name, frames()[0])[model.covered]
        np.testing.assert_allclose(decoded, bright.predict(frames()[0]), rtol=0.02, atol=0.02 * decoded.max())
    with pytest.raises(ValueError, match=r"mean.exr: values up to .* do not fit"):
        export_textures(bright, tmp_path / "exr", formats=["exr"])


def test_layers_hold_maps_side_by_side() -> None:
    rng = np.random.default_rng(0)
    values = rng.normal(size=(5, 3, 4, 1)).astype(np.float32)
    maps = Maps(values, 5, np.ones((3, 4), bool))
    layers = layered(values, 3)
    assert layers.shape == (2, 3, 4, 3)
    np.testing.assert_array_equal(layers[1, ..., 1], values[4, ..., 0])
    assert not layers[1, ..., 2].any()
    np.testing.assert_array_equal(unlayered(layers, maps), values)


def test_ranges_are_of_known_texels() -> None:
    values = np.array([[[-1, 3, 99], [1, 1, -99]], [[2, 2, 0], [2, 2, 0]]], np.float32)[..., None]
    known = np.array([[True, True, False], [True, True, False]])
    scale, bias, t = ranges(Maps(values, 2, known), 1.0, 2.0)
    np.testing.assert_allclose(scale, [4, 1])
    np.testing.assert_allclose(t[0, ..., 0], [[1, 2, 2], [1.5, 1.5, 1]])
    np.testing.assert_allclose(scale[1] * t[1, ..., 0][known] + bias[1], 2)


def test_what_earlier_exports_left_goes(plain: Model, tmp_path: Path) -> None:
    export_textures(plain, tmp_path, formats=[name for name in FORMATS if not name.startswith("bc6h")])
    many = {path.name for path in tmp_path.iterdir()}
    assert {"basis_01.png", "basis-grid.exr", "basis.ktx2", "basis.rgba16f", "transfer-bytes.safetensors"} < many
    (tmp_path / "mine.png").write_bytes(b"")
    written = export_textures(plain, tmp_path, formats=["bytes"])
    assert {path.name for path in tmp_path.iterdir()} == {*(path.name for path in written), "mine.png"}
    assert json.loads((tmp_path / "manifest.json").read_text())["layers"] == []
    export_textures(plain, tmp_path)
    assert {"formats", "decode_formats"}.isdisjoint(json.loads((tmp_path / "manifest.json").read_text()))
    assert not list(tmp_path.glob("*-*.safetensors"))


def test_refit_false_keeps_the_old_coefficients(plain: Model, tmp_path: Path) -> None:
    export_textures(plain, tmp_path, formats=["bytes"], refit=False)
    entry = json.loads((tmp_path / "manifest.json").read_text())["formats"]["bytes"]
    matrix = read_tensors(tmp_path / "transfer-bytes.safetensors")["matrix"]
    expected = np.asarray(plain.relighter.matrix) * np.array(entry["scale"])[:, None]
    np.testing.assert_allclose(matrix[:, :-1], expected, rtol=1e-5)
    constant = np.einsum("b,gbp->gp", entry["bias"], plain.relighter.matrix)
    np.testing.assert_allclose(matrix[:, -1], constant, rtol=1e-4, atol=1e-5 * np.abs(matrix).max())
    assert entry["rounding"]["kept"] == entry["rounding"]["refitted"] > 0


BAD: dict[str, tuple[Any, str]] = {
    "unknown": (["exr", "bc7"], r"formats.*bc7"),
    "none": ([], r"formats: got \[\], expected at least 1 entry"),
    "twice": (["raw", "raw"], r'formats: got "raw" more than once, expected every one once'),
    "no list": ("raw", r"formats: got 'raw', expected a list"),
}


@pytest.mark.parametrize("case", BAD)
def test_formats_that_cannot_be(case: str) -> None:
    asked, words = BAD[case]
    with pytest.raises(UserError, match=words):
        checked({"export": {"formats": asked}})


def test_settings_know_all_formats() -> None:
    from ddprt.sections import ExportConfig

    known = typing.get_args(typing.get_args(ExportConfig.model_fields["formats"].annotation)[0])
    assert set(known) == set(FORMATS)


def test_sides_and_missing_encoders_are_told_before_anything_is_written(
    plain: Model, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "ispc_texcomp", None)
    with pytest.raises(UserError, match=r'expected ispc-texcomp for BC6H; pip install "ddprt\[textures\]"'):
        export_textures(plain, tmp_path / "a", formats=["raw", "bc6h"])
    with pytest.raises(UserError, match=r"lightmap of 30x22 texels, expected multiples of 4 .* atlas.resolution to 32"):
        FORMATS["bc6h-ktx2"].fits(22, 30)
    with pytest.raises(UserError, match='no format of textures "bc7"; known: bc6h'):
        export_textures(plain, tmp_path / "a", formats=["bc7"])
    assert not (tmp_path / "a").exists()
    rows = {row.name: row for row in format_table(plain)}
    assert "pip install" in rows["bc6h"].skipped
    assert rows["bc6h"].bytes is None
    assert "pip install" in told(rows.values())


def test_damaged_files_are_named(tmp_path: Path) -> None:
    write_png(tmp_path / "a.png", np.zeros((2, 2, 3), np.uint8))
    (tmp_path / "a.png").write_bytes((tmp_path / "a.png").read_bytes()[8:])
    with pytest.raises(UserError, match=r"a\.png: got another kind of PNG"):
        read_png(tmp_path / "a.png")
    write_ktx2(tmp_path / "a.ktx2", RGBA16F, 2, 2, 1, bytes(32))
    assert read_ktx2(tmp_path / "a.ktx2", RGBA16F) == (2, 2, 1, bytes(32))
    with pytest.raises(UserError, match=r"a\.ktx2: got another kind of KTX2"):
        read_ktx2(tmp_path / "a.ktx2", BC6H)
    with pytest.raises(ValueError, match="got 15 bytes, expected those of 4x4"):
        decode_bc6h(bytes(15), 4, 4)


def test_descriptor_of_texels_is_what_the_specification_says(tmp_path: Path) -> None:
    """Offsets and numbers of Khronos' texts, and of its reader ktx-parse, which was asked once."""
    write_ktx2(tmp_path / "a.ktx2", RGBA16F, 2, 3, 5, bytes(5 * 48))
    data = (tmp_path / "a.ktx2").read_bytes()
    assert data[:12] == b"\xabKTX 20\xbb\r\n\x1a\n"
    assert struct.unpack_from("<9I", data, 12) == (97, 2, 3, 2, 0, 5, 1, 1, 0)
    start, length, pairs, pairs_length, more, more_length = struct.unpack_from("<IIIIQQ", data, 48)
    assert (start, length, more, more_length) == (104, 4 + 24 + 4 * 16, 0, 0)
    assert struct.unpack_from("<IIHHBBBB4B8B", data, start) == (92, 0, 2, 88, 1, 1, 1, 0, 0, 0, 0, 0, 8, *[0] * 7)
    samples = [struct.unpack_from("<HBBIii", data, start + 28 + 16 * k) for k in range(4)]
    one = 0x3F800000
    assert [sample[:3] for sample in samples] == [(0, 15, 192), (16, 15, 193), (32, 15, 194), (48, 15, 207)]
    assert {sample[3:] for sample in samples} == {(0, -0x40800000, one)}
    assert pairs == start + length
    assert data[pairs : pairs + pairs_length] == (b"\x12\0\0\0KTXorientation\0rd\0\0\0" + b"\x10\0\0\0KTXwriter\0ddprt\0")
    first, size, whole = struct.unpack_from("<QQQ", data, 80)
    assert (first % 8, size, whole, len(data)) == (0, 240, 240, first + 240)


def test_table_tells_bytes_and_errors(plain: Model) -> None:
    truth = lamps()[2][:3]
    rows = {row.name: row for row in format_table(plain, HeldOut(frames(), truth))}
    texels = HEIGHT * WIDTH
    assert rows["raw"].memory_bytes == 2 * texels * 8
    assert rows["bytes"].memory_bytes == 2 * texels * 4
    assert rows["exr, float"].memory_bytes == 2 * texels * 16
    covered = int(plain.covered.sum())
    assert rows["exact, float32"].bytes - rows["int16"].bytes == 2 * BASES * covered
    assert rows["exact, float32"].relative_rmse == 0
    for better, worse in (("exr, half", "bytes"), ("int16", "exr, half"), ("int16", "int16, sparse")):
        assert 0 < rows[better].relative_rmse < rows[worse].relative_rmse
        assert rows[better].rounding < rows[worse].rounding
    area = plain.area / plain.area.sum()
    square = np.einsum("ftc,t->", (plain.predict(frames()) - truth) ** 2, area)
    error = np.sqrt(square / truth.shape[0] / 3) / (np.einsum("ftc,t->", truth, area) / truth.shape[0] / 3)
    np.testing.assert_allclose(rows["exact, float32"].held_out_relative_rmse, error, rtol=1e-3)
    assert {row["name"] for row in json.loads(as_json(rows.values()))} == set(rows)
    bare = {row.name: row for row in format_table(plain)}
    assert bare["bytes"].relative_rmse is None
    assert bare["bytes"].rounding == rows["bytes"].rounding


def test_colours_weigh_as_their_texel() -> None:
    model = learned(channels="multi")
    np.testing.assert_allclose(weights_of(model), np.repeat(model.area / model.area.sum() / 3, 3), rtol=1e-6)


def test_one_format_alone_is_written_where_it_is_told(plain: Model, tmp_path: Path) -> None:
    files, entry = write_format(plain, textures(plain)[0], "raw", tmp_path, refit=True)
    assert [path.name for path in files] == ["basis.rgba16f", "transfer-raw.safetensors"]
    assert entry["layers"] == 2
    assert entry["layer_bytes"] == 8 * HEIGHT * WIDTH


@pytest.mark.slow
def test_table_of_a_run(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    job = tmp_path / "job.toml"
    job.write_text(SMALL)
    out = ["--out", tmp_path / "run", "--quiet"]
    formats = ["--export.formats", '["exr", "raw", "bytes"]']
    assert call("run", job, *out, *formats) == 0
    assert (tmp_path / "run" / "export" / "basis_00.png").is_file()
    assert call("export", job, *out, "--table") == 0
    printed = capsys.readouterr().out
    rows = json.loads((tmp_path / "run" / "export" / "formats.json").read_text())
    assert all(row["name"] in printed for row in rows)
    found = {row["name"]: row for row in rows}
    scores = json.loads((tmp_path / "run" / "metrics.json").read_text())["methods"]["svd-ridge"]
    np.testing.assert_allclose(found["exact, float32"]["held_out_relative_rmse"], scores["relative_rmse"], rtol=0.05)
    assert not (tmp_path / "run" / "export" / "basis_00.png").exists()
