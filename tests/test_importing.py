"""`ddprt import` as a whole: a dataset that goes out and comes in again, factors, photographs, faults, the command line."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from small_job import base, call

import ddprt
from ddprt.dataset.generate import bake
from ddprt.dataset.importers.importing import import_dataset
from ddprt.dataset.importers.recipe import load_recipe
from ddprt.dataset.store import Dataset, open_dataset
from ddprt.errors import UserError
from ddprt.lights import lighting_json
from ddprt.progress import Doubt, Progress
from ddprt.report.evaluate import evaluate
from ddprt.scene.exr import write_exr
from ddprt.scene.mesh import Scene

Options = dict[str, str]


@pytest.fixture(scope="module")
def baked(cornell: Scene, tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    return bake(cornell, config=base(), out=tmp_path_factory.mktemp("baked"))


@pytest.fixture(scope="module")
def plain(baked: Dataset, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The baked dataset as others would write it: plain EXR files, a CSV, an OBJ."""
    folder = tmp_path_factory.mktemp("plain")
    rows = ["name,split,type,x,y,z,r,g,b"]
    for index, entry in enumerate(baked.description["lightings"]):
        for kind in ("direct", "indirect"):
            write_exr(folder / kind / f"lamp{index}.exr", image(baked, baked.maps(kind, [index])[0]))
        for light in lighting_json(baked.lightings[index]):
            cells = [f"lamp{index}", entry["split"], "point", *light["position"], *light["intensity"]]
            rows.append(",".join(map(str, cells)))
    (folder / "lights.csv").write_text("\n".join(rows) + "\n")
    for name in ("position", "normal", "albedo", "area"):
        write_exr(folder / "buffers" / f"{name}.exr", image(baked, baked.gbuffer[name]))
    write_exr(folder / "buffers" / "mask.exr", image(baked, baked.gbuffer["coverage"]))
    np.save(folder / "buffers" / "measured.npy", baked.values(range(len(rows) - 1), 12, "radiosity"))
    assert baked.uv is not None
    lines = [f"v {x!r} {y!r} {z!r}" for x, y, z in baked.occluders.reshape(-1, 3).tolist()]
    lines += [f"vt {u!r} {1 - v!r}" for u, v in baked.uv.reshape(-1, 2).tolist()]
    lines += [f"f {' '.join(f'{k}/{k}' for k in range(first, first + 3))}" for first in range(1, 3 * len(baked.uv), 3)]
    (folder / "room.obj").write_text("\n".join(lines) + "\n")
    return folder


BUFFERS = {key: f"buffers/{key}.exr" for key in ("position", "normal", "albedo", "area", "mask")} | {"quantity": "irradiance"}


def image(data: Dataset, values: np.ndarray) -> np.ndarray:
    found = np.zeros((*data.covered.shape, values.shape[1]), np.float32)
    found[data.covered] = values
    return found


def imported(folder: Path, out: Path, **options: str) -> Dataset:
    recipe, base, _ = load_recipe(folder, options)
    return import_dataset(recipe, base, out, Progress(quiet=True))


def test_what_goes_out_comes_in_again(baked: Dataset, plain: Path, tmp_path: Path) -> None:
    """The same arrays, and the same scores of what is learned from them."""
    data = imported(plain, tmp_path / "data", measured="buffers/measured.npy", **BUFFERS)
    every = range(len(baked.lightings))
    assert (data.covered == baked.covered).all()
    assert (data.area == baked.area).all()
    for kind in ("direct", "indirect"):
        assert (data.maps(kind, every) == baked.maps(kind, every)).all()
    for name in ("position", "albedo", "coverage"):
        assert np.abs(data.gbuffer[name] - baked.gbuffer[name]).max() < 1e-6
    assert (data.values(every, 12, "radiosity") == baked.values(every, 12, "radiosity")).all()
    assert [data.split(name) for name in ("train", "test")] == [baked.split(name) for name in ("train", "test")]
    assert data.lightings == baked.lightings
    scores = []
    for one in (baked, data):
        model = ddprt.fit(one, bases=4, points=12)
        found = evaluate(one, {"svd-ridge": model}, {}).metrics
        scores.append({key: found["methods"]["svd-ridge"][key] for key in ("relative_rmse", "psnr_db", "energy_bias", "bases")})
    assert scores[0] == scores[1]
    assert found["floors"]["noise_relative_rmse"] is None
    with pytest.raises(UserError, match=r"imported without a place; pass measured values"):
        model.measure({"type": "point", "position": [0.2, 0.2, 0.2], "intensity": [1, 1, 1]})


def test_a_mesh_brings_the_atlas_that_was_baked(baked: Dataset, plain: Path, tmp_path: Path) -> None:
    """Unwrapped by itself a mesh would have another atlas; and light on it agrees when it is traced again."""
    said: list[str] = []
    progress = Progress(quiet=True)
    progress.say = said.append  # type: ignore[method-assign]
    recipe, folder, _ = load_recipe(plain, {"geometry": "room.obj", "points": "20", "quantity": "irradiance"})
    data = import_dataset(recipe, folder, tmp_path / "data", progress)
    assert (
        np.abs(
            data.area.sum() / np.linalg.norm(np.cross(*np.diff(baked.occluders, axis=1).swapaxes(0, 1)), axis=1).sum() * 2 - 1
        )
        < 1e-5
    )
    both = data.covered & baked.covered
    assert both.sum() >= 0.98 * baked.covered.sum()
    assert np.median(np.abs(image(data, data.gbuffer["position"]) - image(baked, baked.gbuffer["position"]))[both]) < 1e-5
    again = next(line for line in said if "traced again" in line)
    assert 0.9 < float(again.split("imported / traced ")[1].split(",")[0]) < 1.1, again
    assert len(data.occluders) == len(baked.occluders)
    assert not data.imported["unmeasured"]
    for path in (plain / "direct").iterdir():
        light = ddprt.scene.exr.read_exr(path)[0]
        (tmp_path / "turned" / "direct").mkdir(parents=True, exist_ok=True)
        write_exr(tmp_path / "turned" / "direct" / path.name, light[::-1])
    for name in ("indirect", "lights.csv", "room.obj"):
        (shutil.copytree if (plain / name).is_dir() else shutil.copy)(plain / name, tmp_path / "turned" / name)
    with pytest.warns(Doubt, match=r"they look upside down"):
        imported(tmp_path / "turned", tmp_path / "other", geometry="room.obj", quantity="irradiance", points="100")
    with pytest.warns(Doubt, match=r"imported / traced 3\.\d+"):
        imported(plain, tmp_path / "third", geometry="room.obj", quantity="E/pi", points="100")


@pytest.mark.parametrize(("quantity", "factor"), [("E/pi", np.pi), ("radiosity", 1.0), ("radiance", np.pi)])
def test_factors_reach_the_dataset(quantity: str, factor: float, tmp_path: Path) -> None:
    light = squares(tmp_path, albedo=True)
    data = imported(tmp_path, tmp_path / "out", quantity=quantity, points="4")
    there = light[:, 0] > 0
    albedo = 1.0 if quantity == "E/pi" else np.repeat([[0.25, 0.5, 1.0]], there.sum(), 0)
    assert np.allclose(data.maps("indirect", [0])[0], factor * light[there] / albedo, rtol=1e-3)
    assert data.imported["quantity"] == quantity


def test_nothing_is_known_of_bare_pictures_but_where_their_light_is(tmp_path: Path) -> None:
    """An asymmetric picture keeps its place; black texels do not count; areas are equal."""
    light = squares(tmp_path)
    (tmp_path / "lights.csv").unlink()
    with pytest.warns(Doubt, match=r"no file says what it holds: taken as irradiance"):
        data = imported(tmp_path, tmp_path / "out", points="3")
    assert data.covered.shape == (4, 6)
    assert not data.covered[0, 0]
    assert data.covered[0, 5]
    assert data.covered[3].all()
    assert (image(data, data.maps("indirect", [0])[0]).reshape(-1, 3) == light).all()
    assert set(data.area) == {1.0}
    assert data.gbuffer["position"][0].tolist() == [1.5, 0.5, 0]
    assert data.lightings == ((),) * 5
    assert len(data.occluders) == 0
    assert data.imported["lacks"] == ["noise", "mesh"]
    assert data.imported["known"] == []
    assert np.allclose(data.measured([0])[0], 2 * data.maps("indirect", [0])[0][texels(data)], rtol=1e-3)


def texels(data: Dataset) -> np.ndarray:
    return np.array([np.flatnonzero((data.gbuffer["position"] == place).all(1))[0] for place in data.samples.position])


def squares(folder: Path, albedo: bool = False) -> np.ndarray:
    """Five lightings of a picture of 6 x 4 whose first texel is black; direct is twice indirect. Returns the first indirect."""
    light = (np.arange(24, dtype=np.float32)[:, None] * [1.0, 0.5, 0.25]).astype(np.float32)
    for index in range(5):
        write_exr(folder / "indirect" / f"{index}.exr", (light * (1 + index)).reshape(4, 6, 3))
        write_exr(folder / "direct" / f"{index}.exr", (2 * light * (1 + index)).reshape(4, 6, 3))
    if albedo:
        write_exr(folder / "albedo.exr", np.broadcast_to(np.array([0.25, 0.5, 1.0], np.float32), (4, 6, 3)))
    rows = [f"point,0,0,1,{1 + index},1,1" for index in range(5)]
    (folder / "lights.csv").write_text("\n".join(["type,x,y,z,r,g,b", *rows]) + "\n")
    return light


def relief(folder: Path) -> Callable[[np.ndarray], np.ndarray]:
    """Photographs of a matt relief under 60 suns, and what it looks like under any."""
    side, rng = 12, np.random.default_rng(0)
    x, y = np.meshgrid(np.linspace(-0.6, 0.6, side), np.linspace(0.6, -0.6, side + 2))
    normal = np.stack([x, y, np.sqrt(1 - x**2 - y**2)], 2)
    albedo = rng.uniform(0.3, 0.9, (side + 2, side, 3))
    towards = rng.normal(size=(60, 3))
    towards[:, 2] = 0.6 + np.abs(towards[:, 2])
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    shown = lambda l: (albedo * np.maximum(normal @ l, 0)[..., None]).astype(np.float32)  # noqa: E731
    lines = [str(len(towards))]
    for index, l in enumerate(towards):
        write_exr(folder / f"{index}.exr", shown(l))
        lines.append(f"{index}.exr {l[0]} {l[1]} {l[2]}")
    (folder / "dome.lp").write_text("\n".join(lines) + "\n")
    return shown


def test_a_white_ball_tells_how_a_matt_relief_looks(tmp_path: Path) -> None:
    """By plain least squares: held-out photographs from values on the ball alone."""
    relief(tmp_path)
    data = imported(tmp_path, tmp_path / "out", points="96")
    assert data.covered.shape == (14, 12)
    assert data.imported["kind"] == "photographs"
    assert data.exitant is not None
    assert data.exitant.all()
    assert not data.shaded([0]).any()
    values, maps = (
        [part(data.split(name)) for name in ("train", "test")] for part in (data.measured, lambda i: data.maps("indirect", i))
    )
    x, y = values[0][..., 1].astype(float), maps[0][..., 1].astype(float)
    gram = x @ x.T + 1e-4 * np.eye(len(x))
    found = values[1][..., 1] @ x.T @ np.linalg.solve(gram, y)
    assert np.sqrt(np.mean((found - maps[1][..., 1]) ** 2)) / maps[1][..., 1].mean() < 0.02


@pytest.mark.slow
def test_photographs_of_a_matt_relief_are_relit(tmp_path: Path) -> None:
    """Lambert under 60 suns, relit under one that was never seen, through the model alone."""
    shown = relief(tmp_path)
    data = imported(tmp_path, tmp_path / "out")
    model = ddprt.fit(data, bases=12)
    sun = np.array([0.3, 0.4, 0.87])
    light = model.relight({"type": "directional", "direction": (-sun).tolist(), "irradiance": [2, 2, 2]})
    truth = 2 * shown(sun / np.linalg.norm(sun))
    assert np.sqrt(np.mean((light - truth) ** 2)) / truth.mean() < 0.02
    error = evaluate(data, {"svd-ridge": model}, {}).metrics["methods"]["svd-ridge"]["relative_rmse"]
    assert error < 0.02, error


def test_an_import_is_kept_goes_on_or_is_refused(tmp_path: Path) -> None:
    squares(tmp_path)
    given: Options = {"quantity": "irradiance", "points": "3"}
    data = imported(tmp_path, tmp_path / "out", **given)
    before = (data.folder / "manifest.jsonl").read_bytes()
    (data.folder / "indirect" / "000001.exr").unlink()
    with pytest.raises(UserError, match=r"holds another dataset"):
        imported(tmp_path, tmp_path / "out", **{**given, "points": "4"})
    again = imported(tmp_path, tmp_path / "out", **given)  # as after a kill: from the start, to the same bytes
    assert (again.folder / "manifest.jsonl").read_bytes() == before
    open_dataset(again.folder)
    stamp = (again.folder / "dataset.json").stat().st_mtime_ns
    imported(tmp_path, tmp_path / "out", **given)
    assert (again.folder / "dataset.json").stat().st_mtime_ns == stamp
    write_exr(tmp_path / "direct" / "0.exr", np.ones((4, 6, 3), np.float32))
    with pytest.raises(UserError, match=r"holds another dataset"):
        imported(tmp_path, tmp_path / "out", **given)


def _picture(name: str, value: Any, at: tuple[int, int] = (2, 3), shape: tuple[int, ...] = (4, 6, 3)) -> Callable[[Path], None]:
    def write(folder: Path) -> None:
        image = np.ones(shape, np.float32)
        image[at] = value
        path = folder / name
        if np.isfinite(image).all():
            write_exr(path, image)
        else:
            import OpenEXR

            with OpenEXR.File({"type": OpenEXR.scanlineimage}, {"RGB": image}) as file:
                file.write(str(path))

    return write


FAULTS: dict[str, tuple[Callable[[Path], None], Options, str]] = {
    "lone direct": (lambda f: (f / "indirect/3.exr").unlink(), {}, "got direct light but no indirect of 3"),
    "lone indirect": (lambda f: (f / "direct/3.exr").unlink(), {}, "got indirect light but no direct of 3"),
    "sizes": (_picture("direct/2.exr", 1, shape=(4, 5, 3)), {}, "got 5 x 4 pixels, expected 6 x 4"),
    "NaN": (_picture("indirect/1.exr", np.nan), {}, "got NaN or infinity in row 2, column 3"),
    "negative": (_picture("indirect/1.exr", -0.1), {}, "got -0.1 in row 2, column 3"),
    "channel": (lambda f: None, {"channels": "*DiffDir"}, 'got no layer that "*DiffDir" names, expected one of RGB'),
    "fewer lights": (lambda f: (f / "lights.csv").write_text("type,x,y,z,r,g,b\npoint,0,0,1,1,1,1\n"), {}, "got 1 lightings for 5"),  # noqa: E501
    "names": (lambda f: (f / "lights.csv").write_text("name,type,x,y,z,r,g,b\na,point,0,0,1,1,1,1\n"), {}, 'for picture "0"'),
    "empty mask": (lambda f: write_exr(f / "mask.exr", np.zeros((4, 6, 1), np.float32)), {}, "got an empty mask"),
    "small mask": (lambda f: write_exr(f / "mask.exr", np.ones((4, 4, 1), np.float32)), {}, "got 4 x 4 pixels, expected 6 x 4"),
    "no albedo": (lambda f: None, {"quantity": "radiance"}, "no albedo to divide by"),
    "bright albedo": (_picture("albedo.exr", 2.0), {}, "got albedo 1 to 2, expected 0 to 1"),
    "black": (lambda f: [write_exr(p, np.zeros((4, 6, 3), np.float32)) for p in (f / "indirect").iterdir()], {}, "got black pictures"),  # noqa: E501
    "dark where it counts": (lambda f: write_exr(f / "mask.exr", np.eye(4, 6, dtype=np.float32)[:, :, None] * np.eye(4)[0][:, None, None].astype(np.float32)), {}, "got maps that are black at all 1 texels that count"),  # noqa: E501
    "no points": (lambda f: None, {"points": "0"}, "--points: got 0, expected 1 to 23"),
    "points": (lambda f: None, {"points": "99"}, "--points: got 99, but 23 texels count"),
    "point outside": (lambda f: (f / "points.json").write_text('[{"texel": [0, 0]}]'), {"points": "points.json"}, "got texel [0, 0], which does not count"),  # noqa: E501
    "no stars": (lambda f: None, {"direct": "direct/1.exr"}, "with 0 stars, expected one"),
    "no files": (lambda f: None, {"direct": "straight/*.exr"}, 'got no file for "straight/*.exr"'),
    "no quantity": (lambda f: None, {"quantity": "E"}, 'no quantity "E"'),
    "no colour": (lambda f: None, {"colour": "acesgc"}, 'did you mean "acescg"'),
    "shares": (lambda f: None, {"test": "0.95"}, "expected a sum below 1"),
    "no number": (lambda f: None, {"test": "some"}, "--test: got 'some'"),
    "lone positions": (_picture("position.exr", 1.0), {}, "got no --normal beside it"),
    "wide mesh": (lambda f: None, {"geometry": "room.obj"}, "expected square lightmaps"),
    "darkness": (lambda f: np.save(f / "measured.npy", np.zeros((5, 2, 3))), {}, "measured.npy: got zeros alone"),
    "vectors": (lambda f: np.save(f / "measured.npy", np.ones((4, 2, 3))), {}, "got 4 lightings for 5 pictures"),
    "no light": (lambda f: shutil.rmtree(f / "indirect"), {}, "got no indirect light"),
    "cut short": (lambda f: (f / "direct/0.exr").write_bytes((f / "direct/0.exr").read_bytes()[:200]), {}, "not a whole EXR image"),  # noqa: E501
    "format": (lambda f: (f / "mask.bmp").touch(), {"mask": "mask.bmp"}, 'got suffix ".bmp"'),
}  # fmt: skip


@pytest.mark.parametrize("case", list(FAULTS))
def test_faults_are_told_in_one_line(case: str, tmp_path: Path) -> None:
    squares(tmp_path)
    spoil, options, told = FAULTS[case]
    spoil(tmp_path)
    with pytest.raises(UserError) as caught:
        imported(tmp_path, tmp_path / "out", **{"quantity": "irradiance", "points": "3", **options})
    assert told in str(caught.value)
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "out" / "dataset.json").exists()


def board(folder: Path, lit: slice, gap: float = 0.5, rows: tuple[float, float] = (0.0, 0.5)) -> Path:
    """Maps of 8 x 8 of which some rows are lit, and a mesh of two charts: between `rows` of the map, so far apart."""
    light = np.zeros((8, 8, 3), np.float32)
    light[lit] = 1
    for index in range(5):
        for kind in ("direct", "indirect"):
            write_exr(folder / kind / f"{index}.exr", light * (1 + index))
    (folder / "lights.csv").write_text("name,type,x,y,z,r,g,b\n" + "".join(f"{k},point,0,1,0,1,1,1\n" for k in range(7)))
    text, (top, bottom), wide = "", rows, (1 - gap) / 2
    for chart, left in enumerate((0.0, 1 - wide)):
        places = [(left, bottom), (left + wide, bottom), (left + wide, top), (left, top)]
        text += "".join(f"v {u + chart} {0.0} {v}\nvt {u} {1 - v}\n" for u, v in places)
        text += "f " + " ".join(f"{k}/{k}" for k in range(4 * chart + 1, 4 * chart + 5)) + "\n"
    (folder / "room.obj").write_text(text)
    return folder


BOARD = {"geometry": "room.obj", "quantity": "irradiance", "points": "3"}


@pytest.mark.parametrize(("lit", "upside"), [(slice(4, 8), True), (slice(4, 4), False)])
def test_maps_that_are_black_where_they_count_are_refused(tmp_path: Path, lit: slice, upside: bool) -> None:
    board(tmp_path, lit)
    if not upside:  # lit where no chart is, whichever way up
        for path in (tmp_path / "indirect").iterdir():
            write_exr(path, np.pad(np.ones((8, 1, 3), np.float32), ((0, 0), (3, 4), (0, 0))))
    with pytest.raises(UserError, match="got maps that are black at all 16 texels that count") as caught:
        imported(tmp_path, tmp_path / "out", **BOARD)
    assert ("they look upside down" in str(caught.value)) == upside


def test_files_that_could_all_be_meant_are_refused(tmp_path: Path) -> None:
    """Pictures of two endings, or two lists of lights, used to be left aside without a word; and .PNG was not found."""
    (tmp_path / "direct").mkdir()
    (tmp_path / "direct" / "a.PNG").touch()
    assert load_recipe(tmp_path, {})[0].direct == "direct/*.PNG"
    (tmp_path / "direct" / "b.exr").touch()
    with pytest.raises(UserError, match=r"direct: got pictures that end in \.PNG and \.exr, expected one kind; .* --direct"):
        load_recipe(tmp_path, {})
    options = {"direct": "direct/*.exr"}
    assert load_recipe(tmp_path, options)[0].direct == "direct/*.exr"
    for name in ("lights.csv", "lights.json"):
        (tmp_path / name).touch()
    with pytest.raises(UserError, match=r"got lights\.csv and lights\.json, expected one list of lights; name it"):
        load_recipe(tmp_path, options)
    assert load_recipe(tmp_path, options | {"lights": "lights.csv"})[0].lights == "lights.csv"


def test_an_import_says_what_it_leaves_out(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    board(tmp_path, slice(0, 4))
    for name in ("position", "normal"):
        write_exr(tmp_path / f"{name}.exr", np.ones((8, 8, 3), np.float32))
    _, _, found = load_recipe(tmp_path, BOARD)
    assert "position.exr, normal.exr: left aside for the mesh of --geometry" in found
    with pytest.warns(Doubt, match='2 lightings name no picture and are left out, the first "5"') as told:
        data = imported(tmp_path, tmp_path / "out", **BOARD)
    assert not any("apart" in str(one.message) for one in told)
    assert any("name no picture" in note for note in data.imported["notes"])


@pytest.mark.parametrize(("gap", "said"), [(0.0, True), (0.125, False)])
def test_charts_that_touch_are_told(tmp_path: Path, gap: float, said: bool) -> None:
    board(tmp_path, slice(0, 4), gap=gap + 0.125 * (gap > 0))
    with pytest.warns(Doubt) as told:
        imported(tmp_path, tmp_path / "out", **BOARD)
    assert any("charts of room.obj are not one texel apart" in str(one.message) for one in told) == said


def test_negative_light_is_cut_off_where_it_is_asked(tmp_path: Path) -> None:
    squares(tmp_path)
    _picture("indirect/1.exr", -0.1)(tmp_path)
    data = imported(tmp_path, tmp_path / "out", quantity="irradiance", points="3", clip="true")
    assert data.maps("indirect", [1]).min() == 0


def test_the_command_line_imports_checks_and_learns(plain: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "run"
    words = ["import", plain, "--out", out, "--measured", "buffers/measured.npy", "--mask", "buffers/mask.exr"]
    assert call(*words, "--quantity", "irradiance", "--quiet") == 0
    assert call("verify", out) == 0
    assert call("import", plain, "--out", out, "--no-such", "1") == 2
    small = ["--fit.bases", "4", "--methods.compare", '["svd-ridge"]', "--report.bases_curve", "[1, 4]", "--report.rows", "1"]
    assert call("run", out / "config.toml", *small, "--quiet") == 0
    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics["methods"]["svd-ridge"]["relative_rmse"] < 1
    assert metrics["spot_check"] == {}
    assert "imported" in (out / "report.html").read_text()
    assert (out / "export" / "manifest.json").is_file()
    capsys.readouterr()
    lamp = '{"type": "point", "position": [0.2, 0.2, 0.2], "intensity": [1, 1, 1]}'
    assert call("relight", out / "model.ddprt", "--lighting", lamp, "--out", tmp_path / "a.exr") == 2
    assert "pass measured values to predict" in capsys.readouterr().err
    assert call("bench", out / "config.toml") == 2
    assert "this run holds light that was imported" in capsys.readouterr().err
    (out / "dataset" / "indirect" / "000000.exr").write_bytes(b"")
    assert call("verify", out) == 2
