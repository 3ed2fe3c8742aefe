"""Parts of an import: colours, channels, files, tables of lights, quantities, areas, and what each refuses."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
import pytest
from PIL import Image

from ddprt.dataset.importers.channels import choose, layers
from ddprt.dataset.importers.colour import SPACES, detect, to_rec709
from ddprt.dataset.importers.files import by_key, natural
from ddprt.dataset.importers.lamps import COLUMNS, match, read_table
from ddprt.dataset.importers.light_positions import read_lp, white_ball
from ddprt.dataset.importers.pictures import Wanted, read_picture
from ddprt.dataset.importers.places import _areas
from ddprt.dataset.importers.points import read_vectors
from ddprt.dataset.importers.quantities import QUANTITIES, irradiance
from ddprt.dataset.importers.recipe import Recipe
from ddprt.errors import UserError
from ddprt.lights import DirectionalLight
from ddprt.scene.exr import read_channels
from ddprt.scene.files import load_lightmapped
from ddprt.transport.embree import Tracer
from ddprt.transport.measure import measure
from ddprt.verbs import VERBS

AP1 = SPACES["acescg"].chromaticities


def exr(path: Path, planes: dict[str, np.ndarray], **header: Any) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage, **header}
    with OpenEXR.File(header, planes) as file:
        file.write(str(path))
    return path


def plane(value: float = 1.0) -> np.ndarray:
    return np.full((4, 6), value, np.float32)


@pytest.mark.parametrize("name", list(SPACES))
def test_white_and_grey_stay_what_they_are(name: str) -> None:
    assert np.allclose(to_rec709(SPACES[name].chromaticities) @ np.ones(3), 1, atol=1e-12)


def test_acescg_to_rec709_is_the_published_matrix() -> None:
    published = [[1.70505, -0.62179, -0.08326], [-0.13026, 1.14080, -0.01055], [-0.02400, -0.12897, 1.15297]]
    assert np.abs(to_rec709(AP1) - published).max() < 2e-4


DETECTED: dict[str, tuple[tuple[str, str, dict[str, str], Any, bool], str]] = {
    "asked": (("acescg", "a.exr", {"colorspace": "srgb"}, None, False), "acescg (as asked)"),
    "attribute": (("auto", "a_srgb.exr", {"oiio:ColorSpace": "ACEScg"}, AP1, False), 'acescg (the file says oiio:ColorSpace "ACEScg")'),  # noqa: E501
    "blender's trap": (("auto", "a.exr", {"colorInteropID": "srgb_rec709_display"}, None, False), "srgb (the file says"),
    "blender's data": (("auto", "a.exr", {"colorInteropID": "data"}, None, False), "linear-rec709 (the file says"),
    "chromaticities": (("auto", "a_srgb.exr", {}, AP1, False), "acescg (by the file's chromaticities)"),
    "own chromaticities": (("auto", "a.exr", {}, (0.7, 0.3, 0.2, 0.7, 0.1, 0.05, 0.3127, 0.329), False), "linear, with the file's own"),  # noqa: E501
    "name": (("auto", "lamp_lin_rec2020_3.exr", {}, None, False), "linear-rec2020 (by the file's name)"),
    "an innocent name": (("auto", "raw_data.exr", {}, None, False), "linear-rec709 (assumed)"),
    "picture": (("auto", "a.png", {}, None, True), "srgb (taken as sRGB"),
}  # fmt: skip


@pytest.mark.parametrize("case", list(DETECTED))
def test_colour_spaces_are_detected(case: str) -> None:
    (asked, name, attributes, chromaticities, encoded), told = DETECTED[case]
    assert detect(asked, Path(name), attributes, chromaticities, encoded=encoded).told.startswith(told)


def test_colours_of_a_file_arrive_in_rec709(tmp_path: Path) -> None:
    light = np.random.default_rng(0).random((3, 4, 6)).astype(np.float32)
    planes = dict(zip("RGB", light, strict=True))
    wide = read_picture(exr(tmp_path / "wide.exr", planes, chromaticities=AP1), Wanted("indirect")).light
    assert np.abs(wide - np.einsum("ij,jhw->hwi", to_rec709(AP1), light)).max() < 1e-5
    trap = read_picture(exr(tmp_path / "trap.exr", planes, colorInteropID="srgb_rec709_display"), Wanted("indirect")).light
    assert abs(float(trap[0, 0, 0]) - ((light[0, 0, 0] + 0.055) / 1.055) ** 2.4) < 1e-6
    grey = read_picture(exr(tmp_path / "grey.exr", {"Y": light[0]}), Wanted("indirect")).light
    assert (grey == light[0][..., None]).all()
    byte = np.arange(24, dtype=np.uint8).reshape(4, 6) * 10
    Image.fromarray(np.stack([byte] * 3 + [255 * (byte > 40)], 2).astype(np.uint8)).save(tmp_path / "a.png")
    png = read_picture(tmp_path / "a.png", Wanted("indirect"))
    assert png.coarse
    assert png.alpha is not None
    assert (png.alpha > 0).sum() == 19
    assert abs(float(png.light[3, 5, 0]) - ((230 / 255 + 0.055) / 1.055) ** 2.4) < 1e-6


BLENDER = ["R", "G", "B", *(f"ViewLayer.{part}.{c}" for part in ("DiffDir", "DiffInd") for c in "BGR"), "ViewLayer.Depth.V"]
CHOSEN: dict[str, tuple[list[str], str, str, Any]] = {
    "plain": (["B", "G", "R", "A"], "", "direct", ("R", "G", "B")),
    "grey": (["Y"], "", "direct", ("Y",)),
    "plain before others": (BLENDER, "", "direct", ("R", "G", "B")),
    "usual layer": (BLENDER[3:], "", "indirect", tuple(f"ViewLayer.DiffInd.{c}" for c in "RGB")),
    "usual layer of the other": (BLENDER[3:], "", "direct", tuple(f"ViewLayer.DiffDir.{c}" for c in "RGB")),
    "wildcard, any case": (BLENDER, "*diffdir", "indirect", tuple(f"ViewLayer.DiffDir.{c}" for c in "RGB")),
    "positions": (["p.X", "p.Y", "p.Z"], "", "position", ("p.X", "p.Y", "p.Z")),
    "three with commas": (BLENDER, "B,G,R", "direct", ("B", "G", "R")),
    "grey layer": (BLENDER, "ViewLayer.Depth", "direct", ("ViewLayer.Depth.V",)),
    "several": (["a.R", "a.G", "a.B", "b.R", "b.G", "b.B"], "", "direct", "got layers a, b, expected one"),
    "unknown": (BLENDER, "Glossy", "direct", 'got no layer that "Glossy" names, expected one of RGB, ViewLayer.DiffDir'),
    "two fit": (BLENDER, "*Diff*", "direct", "got 2 layers (ViewLayer.DiffDir, ViewLayer.DiffInd)"),
    "no such channel": (BLENDER, "R,G,X", "direct", 'got channel X in "R,G,X"'),
    "two channels": (BLENDER, "R,G", "direct", "got 2 channels"),
}


@pytest.mark.parametrize("case", list(CHOSEN))
def test_channels_are_chosen(case: str) -> None:
    names, asked, kind, expected = CHOSEN[case]
    if isinstance(expected, str):
        with pytest.raises(UserError) as caught:
            choose(names, asked, kind, "a.exr")
        assert expected in str(caught.value)
    else:
        assert choose(names, asked, kind, "a.exr")[1] == expected


def test_blenders_layers_say_what_they_hold(tmp_path: Path) -> None:
    path = exr(tmp_path / "a.exr", {name: plane(index) for index, name in enumerate(BLENDER)})
    assert read_picture(path, Wanted("direct")).quantity == ""
    found = read_picture(path, Wanted("direct", "*DiffDir"))
    assert found.quantity == "E/pi"
    assert found.light[0, 0].tolist() == [5, 4, 3]
    assert set(layers(read_channels(path).planes)) == {"", "ViewLayer.DiffDir", "ViewLayer.DiffInd", "ViewLayer.Depth"}


@pytest.mark.parametrize(("name", "factor"), [("irradiance", 1), ("E/pi", np.pi), ("radiosity", 2), ("radiance", 2 * np.pi)])
def test_factors_are_exact(name: str, factor: float) -> None:
    light, albedo = np.full((5, 3), 0.25, np.float32), np.full((5, 3), 0.5, np.float32)
    assert (irradiance(light, QUANTITIES[name], albedo) == np.float32(0.25 * factor)).all()


def test_keys_are_what_the_star_stands_for(tmp_path: Path) -> None:
    for name in ("10", "9", "x"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "direct.exr").touch()
    assert list(by_key(tmp_path, "*/direct.exr", "--direct")) == ["9", "10", "x"]
    assert sorted(["a10", "a9", "a"], key=natural) == ["a", "a9", "a10"]


def test_a_table_of_lights_is_read_as_its_json(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text(
        "# two lamps in b\nname,type,x,y,z,dx,dy,dz,r,g,b,radius,inner_deg,outer_deg\n"
        "b,point,1,2,3,,,,4,5,6,,,\nb,spot,1,2,3,0,-1,0,4,5,6,,10,20\na,directional,,,,0,0,-1,1,1,1,,,\na2,sphere,0,1,2,,,,7,8,9,.5,,\n"
    )
    point = {"type": "point", "position": [1, 2, 3], "intensity": [4, 5, 6]}
    spot = {**point, "type": "spot", "direction": [0, -1, 0], "inner_deg": 10, "outer_deg": 20}
    sun = {"type": "directional", "direction": [0, 0, -1], "irradiance": [1, 1, 1]}
    ball = {"type": "sphere", "center": [0, 1, 2], "radius": 0.5, "radiance": [7, 8, 9]}
    named = [{"name": "b", "lights": [point, spot]}, {"name": "a", "lights": [sun]}, {"name": "a2", "lights": [ball]}]
    (tmp_path / "a.json").write_text(json.dumps(named))
    rows = read_table(tmp_path / "a.csv")
    assert rows == read_table(tmp_path / "a.json")
    assert [row.name for row in match(rows, ["a", "b"], "a.csv")] == ["a", "b"]
    (tmp_path / "plain.json").write_text(json.dumps([[sun], [point]]))
    assert match(read_table(tmp_path / "plain.json"), ["x", "y"], "")[1].lighting[0].kind == "point"


HEAD = "name,type,x,y,z,r,g,b\n"
TABLES = {
    "unknown column": ("name,type,x,y,z,r,g,blue\n", 'got column "blue"'),
    "no type": ("name,x\na,1\n", "got no column type"),
    "unknown light": (HEAD + "a,lamp,0,0,0,1,1,1\n", 'got type "lamp" in row 1'),
    "no number": (HEAD + "a,point,0,x,0,1,1,1\n", 'got y "x" in row 1'),
    "short row": (HEAD + "a,point,0\n", "got 3 cells in row 1, expected 8"),
    "idle cell": (HEAD + "a,directional,1,0,0,1,1,1\n", "got x in row 1, which a directional light has not"),
    "empty": (HEAD, "got no lighting"),
    "split of some": ("name,split,type,x,y,z,r,g,b\na,train,point,0,0,0,1,1,1\nb,,point,0,0,0,1,1,1\n", "got a split for some"),
    "no split": ("name,split,type,x,y,z,r,g,b\na,trial,point,0,0,0,1,1,1\n", 'got split "trial"'),
    "two splits": (
        "name,split,type,x,y,z,r,g,b\na,train,point,0,0,0,1,1,1\na,test,point,0,0,0,1,1,1\n",
        'got "a" in two splits',
    ),
    "negative": (HEAD + "a,point,0,0,0,-1,1,1\n", "lighting 0[0].intensity"),
}


@pytest.mark.parametrize("case", list(TABLES))
def test_faulty_tables_are_told(case: str, tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text(TABLES[case][0])
    with pytest.raises(UserError) as caught:
        read_table(tmp_path / "a.csv")
    assert TABLES[case][1] in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("photos", 'got "photos" first'),
        ("2\na.png 0 0 1\n", "got 1 lines for 2"),
        ("1\na.png 0 0\n", "in line 2, expected a name and a direction"),
        ("1\n\na.png 0 0 0\n", "in line 3, expected a name and a direction"),
        ("1\nb c.png 0 0 1\n", "got b c.png in line 2, which is not there"),
        ("2\na.png 0 0 1\na.png 0 1 1\n", "got a.png again in line 3, expected each photograph once"),
        ("", 'got "" first'),
    ],
)
def test_faulty_light_positions_are_told(text: str, told: str, tmp_path: Path) -> None:
    (tmp_path / "a.png").touch()
    (tmp_path / "a.lp").write_text(text)
    with pytest.raises(UserError) as caught:
        read_lp(tmp_path / "a.lp")
    assert told in str(caught.value)


def test_light_travels_from_where_the_file_points_to(tmp_path: Path) -> None:
    (tmp_path / "a b.png").touch()
    (tmp_path / "a.lp").write_text("1\na b.png 0.5 0.25 2\n")
    ((path, lighting),) = read_lp(tmp_path / "a.lp")
    towards = np.array([0.5, 0.25, 2]) / np.linalg.norm([0.5, 0.25, 2])
    assert path.name == "a b.png"
    assert np.allclose(lighting[0].direction, -towards)


def test_the_white_ball_is_lit_by_the_cosine() -> None:
    samples, corners = white_ball(64, 0)
    light = DirectionalLight(direction=(1, 2, -3), irradiance=(1, 2, 3))
    found = measure(Tracer(corners), (light,), samples.position, samples.normal, seed=0)
    cosine = np.maximum(samples.normal @ -np.array([1, 2, -3]) / np.sqrt(14), 0)
    assert np.abs(found - cosine[:, None] * [1, 2, 3]).max() < 1e-5
    assert np.abs(samples.normal.mean(0)).max() < 0.05
    assert len(np.unique(samples.normal, axis=0)) == 64


def test_areas_by_neighbours_are_those_of_the_surface() -> None:
    v, u = np.indices((8, 10)).astype(np.float32)
    left, right = np.stack([0.1 * u, 0.2 * v, 0 * u], 2), np.stack([100 + 0.3 * u, 0 * u, 0.1 * v], 2)
    position = np.where((u < 5)[..., None], left, right)  # two charts side by side
    covered = np.ones((8, 10), bool)
    covered[0] = False
    area = _areas(position, covered)
    assert np.abs(area[1:, :5] - 0.02).max() < 1e-5
    assert np.abs(area[1:, 5:] - 0.03).max() < 2e-4


@pytest.mark.parametrize(
    ("write", "told"),
    [
        (lambda path: np.save(path, np.ones((3, 4))), "got shape (3, 4), expected (lightings, points, 3)"),
        (lambda path: np.save(path, np.full((2, 4, 3), np.nan)), "in lighting 0"),
        (lambda path: np.save(path, -np.ones((2, 4, 3))), "got a negative"),
        (lambda path: path.write_bytes(b"nothing"), "not a table of measured values"),
    ],
)
def test_faulty_vectors_are_told(write: Any, told: str, tmp_path: Path) -> None:
    write(tmp_path / "a.npy")
    with pytest.raises(UserError) as caught:
        read_vectors(tmp_path / "a.npy")
    assert told in str(caught.value)


def test_vectors_of_text_are_those_of_numbers(tmp_path: Path) -> None:
    values = np.arange(24, dtype=np.float32).reshape(2, 4, 3) / 8
    np.save(tmp_path / "a.npy", values)
    np.savez(tmp_path / "a.npz", values)
    np.savetxt(tmp_path / "a.csv", values.reshape(2, 12), delimiter=",")
    for name in ("a.npy", "a.npz", "a.csv"):
        assert (read_vectors(tmp_path / name) == values).all()


def test_cropped_pictures_are_refused(tmp_path: Path) -> None:
    window = (np.array([0, 0], np.int32), np.array([9, 9], np.int32))
    path = exr(tmp_path / "a.exr", {"Y": plane()}, displayWindow=window)
    with pytest.raises(UserError, match=r"save it without cropping"):
        read_channels(path)


OBJ = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\n{}f 1/1 2/2 3/3\nf 1/1 3/3 4/4\n"


def test_lightmap_coordinates_of_a_mesh_count_from_the_top(tmp_path: Path) -> None:
    (tmp_path / "a.obj").write_text(OBJ.format("vt 0 0\nvt .5 0\nvt .5 1\nvt 0 1\n"))
    scene = load_lightmapped(tmp_path / "a.obj")
    assert scene.lightmap is not None
    corner = np.flatnonzero((scene.positions == [0, 0, 0]).all(1))[0]
    assert scene.lightmap[corner].tolist() == [0, 1]
    (tmp_path / "b.obj").write_text(OBJ.format("vt 0 0\nvt 5 0\nvt 5 1\nvt 0 1\n"))
    with pytest.raises(UserError, match=r"got lightmap coordinates from 0 to 5"):
        load_lightmapped(tmp_path / "b.obj")


def test_the_verb_knows_every_key_of_a_recipe() -> None:
    verb = VERBS["import"]
    assert {key.replace("-", "_") for key in (*verb.options, *verb.flags)} - {"out"} == set(Recipe.model_fields)
    assert set(COLUMNS) >= {"name", "split", "type", "x", "radius", "half_u"} - {"half_u"}
