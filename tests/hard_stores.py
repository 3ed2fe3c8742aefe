"""Numbers on their way to disk and back: half floats under an exposure, tensor files, exported textures."""

import json
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import oracles
from hard_arrays import changed, make_data, refusal
from hard_bakes import FAINTEST, HALF, finite, over, worst
from hard_cases import REFUSED, HardCase, Outcome
from hard_flaws import high_dynamic_range
from oracles import U32, over_bound

import ddprt
import ddprt.export.textures
from ddprt.dataset import store
from ddprt.errors import UserError
from ddprt.files import read_tensors, write_tensors
from ddprt.scene.exr import exposure_for, read_exr, write_exr


def _half_floats(peak: float, least: float) -> Callable[[], Outcome]:
    """A map as half floats: 11 bits for all above 2^-29 of the peak, half the smallest step below."""

    def run() -> Outcome:
        image = np.logspace(np.log10(least), np.log10(peak), 48).astype(np.float32).reshape(4, 4, 3)
        with tempfile.TemporaryDirectory() as folder:
            try:
                store.write_map(Path(folder) / "map.exr", image)
            except UserError as error:
                return refusal(error)
            back = store.read_map(Path(folder) / "map.exr")
        exposure = exposure_for(float(image.max())) - 15
        bound = np.maximum(2.0**-11 * np.abs(image.astype(float)), np.ldexp(2.0**-25, exposure)) + 2.0**-150
        return Outcome(over_bound(back.astype(float) - image, bound), "ok", bool(np.isfinite(back).all()))

    return run


def _half_overflow() -> Outcome:
    """Basis textures as half floats without an exposure: what does not fit is refused, never infinite."""
    image = np.full((2, 2, 3), 65536.0, np.float32)
    with tempfile.TemporaryDirectory() as folder:
        try:
            write_exr(Path(folder) / "map.exr", image, half=True)
        except ValueError as error:
            return Outcome(0.0 if str(error).startswith("map.exr: values up to 65536 do not fit") else np.inf, "refused")
        return Outcome(np.inf, "ok", bool(np.isfinite(read_exr(Path(folder) / "map.exr")[0]).all()))


def _tensors() -> Outcome:
    """Every finite float32, the odd ones among them, comes back bit by bit."""
    odd = np.array([0.0, -0.0, 2.0**-149, -(2.0**-126), 1 + 2 * U32, oracles.LARGEST32, -oracles.LARGEST32], np.float32)
    with tempfile.TemporaryDirectory() as folder:
        write_tensors(Path(folder) / "t.safetensors", {"odd": odd})
        back = read_tensors(Path(folder) / "t.safetensors")["odd"]
    return Outcome(0.0 if back.tobytes() == odd.tobytes() else np.inf)


def _exported() -> Outcome:
    """Basis textures in half floats, scaled to a peak of 1, with a basis of 12 decades: 2^-11 relative or 2^-25 absolute."""
    measured, indirect = changed(high_dynamic_range)()
    model = ddprt.fit(make_data(measured, indirect), bases=4, ridge=1e-6)
    U = np.asarray(model.relighter.basis, float)
    with tempfile.TemporaryDirectory() as folder:
        ddprt.export.textures.export_textures(model, folder, gutter=0)
        layer = read_exr(Path(folder) / "basis_00.exr")[0][0].astype(float)
        scale = np.array(json.loads((Path(folder) / "manifest.json").read_text())["basis_scale"])
    back = (layer * scale[: layer.shape[1]]).T[: len(U)]
    bound = scale[: len(U), None] * np.maximum(2.0**-11 * np.abs(U) / scale[: len(U), None], 2.0**-25) + 4 * U32 * np.abs(U)
    return Outcome(over_bound(back - U, bound), model.relighter.report.status, bool(np.isfinite(layer).all()))


def _wide_map() -> Outcome:
    """From 1e-6 to 1e6: nearly nine decades below the peak keep the bits of a half, the rest the spacing of its faintest."""
    image = np.geomspace(1e-6, 1e6, 16 * 16 * 3).reshape(16, 16, 3).astype(np.float32)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "map.exr"
        store.write_map(path, image)
        found = store.read_map(path)
    return Outcome(worst(over(found, image, HALF * image + FAINTEST / 2 * 1e6)), finite=finite(found))


CASES: tuple[HardCase, ...] = (
    HardCase(
        "a map of 1e30 in half floats", "halves end at 65504", "11 bits, thanks to the exposure", _half_floats(1e30, 1e24)
    ),
    HardCase(
        "a map of 1e-30 in half floats", "halves begin at 6e-8", "11 bits, thanks to the exposure", _half_floats(1e-30, 1e-36)
    ),
    HardCase(
        "a map of subnormals in half floats",
        "the exposure itself is past 2^126",
        "to the smallest step",
        _half_floats(1e-39, 1e-44),
    ),
    HardCase(
        "eighteen decades in half floats",
        "halves span twelve",
        "11 bits down to 2^-29 of the peak, then the smallest step",
        _half_floats(1e6, 1e-12),
    ),
    HardCase("the largest float32 in half floats", "its power of two is past float32", "11 bits", _half_floats(3.4e38, 1e30)),
    HardCase("a half float past 65504", "a plain cast makes it infinite", "refused", _half_overflow, REFUSED),
    HardCase("odd numbers in a tensor file", "subnormals, negative zero, the largest", "the same bits", _tensors),
    HardCase(
        "basis textures of twelve decades",
        "a peak of 1 leaves 2^-24 for the faintest",
        "11 bits or the smallest step",
        _exported,
        frozenset({"worse_than_mean"}),
    ),
    HardCase("HDR map", "twelve decades in one map", "eleven bits down to 2e-9 of the peak", _wide_map),
)
