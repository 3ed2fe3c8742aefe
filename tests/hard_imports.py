"""Numbers that another program made: in the files of a dataset, and in the values asked at run time."""

import tempfile
from collections.abc import Callable
from pathlib import Path

import hard_bakes
import numpy as np
from hard_arrays import BASES, TEST, TEXELS, Arrays, make_data, refusal, room
from hard_cases import REFUSED, HardCase, Outcome
from oracles import U32, over_bound, rounding

import ddprt
from ddprt.dataset import store
from ddprt.dataset.manifest import Manifest, map_name
from ddprt.errors import UserError
from ddprt.files import read_tensors, write_tensors
from ddprt.scene.exr import read_exr, write_exr


def _imported(kind: str, value: float, *, split: str = "train") -> Callable[[], Outcome]:
    """A dataset on disk with one odd number in it."""

    def run() -> Outcome:
        measured, indirect = room()
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            data = make_data(measured, indirect)
            on_disk(data, folder)
            index = data.split(split)[1]
            if kind == "measured":
                light = data.measured_light[index].copy()
                light[3, 1] = value
                path = folder / map_name(kind, index)
                write_tensors(path, {"irradiance": light})
            else:
                image = data.indirect_light[index][None].copy() if kind != "area" else np.ones((1, TEXELS, 1), np.float32)
                image[0, 3, -1] = value
                path = folder / (f"atlas/{kind}.exr" if kind == "area" else map_name(kind, index))
                raw_exr(path, image)
            try:
                model = ddprt.fit(ddprt.open_dataset(folder), bases=BASES, ridge=1e-3)
            except UserError as error:
                got = "NaN or infinity" if not np.isfinite(value) else f"negative values (down to {value:.3g})"
                return refusal(error, f"{path.name}: got {got}")
            light = model.predict(measured[-TEST:])
            return Outcome(np.inf, model.relighter.report.status, bool(np.isfinite(light).all()))

    return run


def _overflowing_samples() -> Outcome:
    """Ten samples in five points whose sum is past float32 though their mean is not: the mean, up to its own rounding."""
    measured, indirect = room()
    data = make_data(measured, indirect)
    data.measured_light[1] = 3e38
    with tempfile.TemporaryDirectory() as name:
        on_disk(data, Path(name))
        found = ddprt.open_dataset(name).values([1], 5, "irradiance")
    exact = float(np.float32(3e38))
    return Outcome(over_bound(found - exact, rounding(10, U32) * exact), "ok", bool(np.isfinite(found).all()))


def raw_exr(path: Path, image: np.ndarray, attributes: dict[str, str] | None = None) -> None:
    """A float EXR as another program may write it, with whatever is in it."""
    import OpenEXR

    name, pixels = ("Y", image[..., 0].copy()) if image.shape[2] == 1 else ("RGB", image)
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage, **(attributes or {})}
    with OpenEXR.File(header, {name: pixels}) as file:
        file.write(str(path))


def on_disk(data: Arrays, folder: Path) -> None:
    """Writes a made-up dataset as a bake would."""
    store.write_description(folder, data.description)
    manifest, samples = Manifest(folder), data.samples
    tensors = {"position": samples.position, "normal": samples.normal, "albedo": samples.albedo}
    write_tensors(folder / "points.safetensors", {**tensors, "spacing": np.array([samples.spacing])})
    write_tensors(folder / "scene.safetensors", {"corners": data.occluders})
    for name in store.ATLAS_FILES:
        channels = 1 if name.endswith(("area.exr", "coverage.exr")) else 3
        values = data.area[:, None] if name.endswith("area.exr") else np.full((len(data.area), channels), 0.5)
        write_exr(folder / name, values[None].astype(np.float32))
    for index in range(len(data.measured_light)):
        write_tensors(folder / map_name("measured", index), {"irradiance": data.measured_light[index]})
        for kind in ("direct", "indirect", "noise"):
            write_exr(folder / map_name(kind, index), data.indirect_light[index][None])
    for name in store.expected_files(data.description):
        manifest.add(name)


def _refuses_values(value: float) -> Callable[[], Outcome]:
    def run() -> Outcome:
        measured, indirect = room()
        model = ddprt.fit(make_data(measured, indirect), bases=BASES, ridge=1e-3)
        probes = measured[-TEST:].copy()
        probes[0, 0, 0] = value
        try:
            light = model.predict(probes)
        except UserError as error:
            return refusal(error, "values: got NaN or infinity")
        return Outcome(np.inf, "ok", bool(np.isfinite(light).all()))

    return run


def spoilt(kind: str, value: float, *words: str) -> Outcome:
    """One bad number in a finished dataset on disk: refused by name of file, before anything is learned from it."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "dataset"
        data = hard_bakes.baked(hard_bakes.room(), hard_bakes.LAMPS, out=out)
        if kind == "measured":
            path = out / map_name(kind, 1)
            values = read_tensors(path)["irradiance"].copy()
            values[3, 1] = value
            write_tensors(path, {"irradiance": values})
        else:
            path = out / "atlas" / "area.exr" if kind == "area" else out / map_name(kind, 1)
            image, header = read_exr(path)
            image[tuple(np.argwhere(data.covered)[7])] = value
            raw_exr(path, image, {key: text for key, text in header.items() if key.startswith("ddprt")})
        return hard_bakes.refused(lambda: ddprt.fit(ddprt.open_dataset(out)), path.name, *words)


def _bad_exposure() -> Outcome:
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "dataset"
        hard_bakes.baked(hard_bakes.room(), hard_bakes.LAMPS, out=out)
        path = out / map_name("indirect", 1)
        write_exr(path, read_exr(path)[0], half=True, attributes={"ddprt_exposure": "4000"})
        return hard_bakes.refused(lambda: ddprt.fit(ddprt.open_dataset(out)), path.name, "infinity")


CASES: tuple[HardCase, ...] = (
    HardCase(
        "NaN among imported measurements",
        "spreads through every norm",
        "refused by the name of the file",
        _imported("measured", np.nan),
        REFUSED,
    ),
    HardCase(
        "infinity among imported measurements",
        "inf / inf",
        "refused by the name of the file",
        _imported("measured", np.inf),
        REFUSED,
    ),
    HardCase(
        "a negative imported measurement",
        "no light is negative",
        "refused by the name of the file",
        _imported("measured", -1.0),
        REFUSED,
    ),
    HardCase(
        "NaN in an imported map",
        "one texel of one lighting",
        "refused by the name of the file",
        _imported("indirect", np.nan),
        REFUSED,
    ),
    HardCase(
        "infinity in an imported map",
        "one texel of one lighting",
        "refused by the name of the file",
        _imported("indirect", np.inf),
        REFUSED,
    ),
    HardCase(
        "a negative value in an imported map",
        "other renderers' filters ring",
        "refused by the name of the file",
        _imported("indirect", -1e-3),
        REFUSED,
    ),
    HardCase(
        "NaN in an imported area",
        "all weights become NaN",
        "refused by the name of the file",
        _imported("area", np.nan),
        REFUSED,
    ),
    HardCase("supersamples whose sum is past float32", "their mean is not", "the mean, within rounding", _overflowing_samples),
    HardCase("NaN asked at run time", "an engine divides by 0", "refused", _refuses_values(np.nan), REFUSED),
    HardCase("infinity asked at run time", "an engine overflows", "refused", _refuses_values(-np.inf), REFUSED),
    *(
        HardCase(
            f"{what} in a {kind} file",
            "another program wrote the dataset",
            "refused",
            lambda k=kind, v=value, w=what: spoilt(k, v, w),
            REFUSED,
        )
        for kind, what, value in (
            ("indirect", "NaN", np.nan),
            ("indirect", "infinity", np.inf),
            ("indirect", "negative", -1.0),
            ("measured", "NaN", np.nan),
            ("measured", "negative", -1.0),
            ("area", "NaN", np.nan),
        )
    ),
    HardCase("exposure of 4000", "a header that makes infinity of light", "refused", _bad_exposure, REFUSED),
)
