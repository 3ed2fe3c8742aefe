"""Where texels are: on a mesh with lightmap coordinates, in a G-buffer, or nowhere but in their picture."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ddprt.axes import Bool, Float32, Float64
from ddprt.dataset.importers.pictures import Wanted, read_picture
from ddprt.dataset.importers.quantities import Quantity, divisible
from ddprt.dataset.importers.recipe import Recipe
from ddprt.dataset.store import Dataset
from ddprt.errors import UserError
from ddprt.lights.light import unit
from ddprt.scene.atlas import measured_atlas
from ddprt.scene.checks import UNSAID
from ddprt.scene.files import load_lightmapped
from ddprt.scene.material import Material
from ddprt.scene.mesh import Scene
from ddprt.scene.own_charts import charts_apart

_LAPPED = 1.01  # of a texel: more than that of it is covered twice


@dataclass(frozen=True, eq=False)
class Places:
    """The texels that count, in row-major order.

    Attributes:
      covered: which texels of the maps.
      position: metres in the world; texels from the top left corner (x to the right, y down) where that is not known.
      normal, albedo: of each; (0, 0, 1) and 1 where they are not known.
      area: m²; 1 where it is not known.
      coverage: share of the texel that is covered.
      corners: triangles that cast shadows, metres; none where there is no mesh.
      uv: their lightmap coordinates; None likewise.
      known: what is known: "position", "area", "albedo", "mesh".
      notes: what is to be told of them, a line each.
    """

    covered: Bool[np.ndarray, "height width"]
    position: Float32[np.ndarray, "texels 3"]
    normal: Float32[np.ndarray, "texels 3"]
    albedo: Float32[np.ndarray, "texels 3"]
    area: Float32[np.ndarray, " texels"]
    coverage: Float32[np.ndarray, " texels"]
    corners: Float64[np.ndarray, "triangles 3 3"]
    uv: Float64[np.ndarray, "triangles 3 2"] | None
    known: frozenset[str]
    notes: tuple[str, ...] = ()

    def kept(self, texels: Bool[np.ndarray, " texels"]) -> "Places":
        """Some of the texels."""
        covered = self.covered.copy()
        covered[self.covered] = texels
        names = ("position", "normal", "albedo", "area", "coverage")
        return replace(self, covered=covered, **{name: getattr(self, name)[texels] for name in names})

    def image(self, values: np.ndarray) -> np.ndarray:
        """Values of the texels as a picture, 0 elsewhere."""
        image = np.zeros((*self.covered.shape, *values.shape[1:]), values.dtype)
        image[self.covered] = values
        return image


def find_places(recipe: Recipe, folder: Path, shape: tuple[int, int], lit: Bool[np.ndarray, "height width"]) -> Places:
    """The texels of an import.

    Args:
      recipe, folder: where geometry and mask are.
      shape: height and width of the maps.
      lit: texels that some map lights; they count where no mask and no geometry says which do.
    Raises:
      UserError: a picture of another size, an odd mesh or G-buffer, or nothing is left.
    """
    if recipe.geometry and recipe.position:
        raise UserError("--geometry: got --position too, expected a mesh or a G-buffer; leave one of them out")
    reader = _Maps(folder, shape)
    places = _on_mesh(recipe, folder, shape) if recipe.geometry else _in_picture(recipe, reader, lit)
    if recipe.mask:
        mask = reader.read("mask", recipe.mask)
        keep = mask[places.covered][:, 0] > 0
        if not keep.any():
            raise UserError(f"{recipe.mask}: got an empty mask, expected texels above 0; mend it, or leave it out")
        places = places.kept(keep)
        if not recipe.geometry:
            places = replace(places, coverage=np.minimum(mask[places.covered][:, 0], 1).astype(np.float32))
    if recipe.albedo:
        albedo = reader.read("albedo", recipe.albedo, "auto")[places.covered]
        if albedo.min() < 0 or albedo.max() > 1 + 1e-3:
            raise UserError(f"{recipe.albedo}: got albedo {albedo.min():.3g} to {albedo.max():.3g}, expected 0 to 1; mend it")
        places = replace(places, albedo=np.clip(albedo, 0, 1).astype(np.float32), known=places.known | {"albedo"})
    if recipe.area:
        area = reader.read("area", recipe.area)[places.covered][:, 0]
        if area.min() < 0 or not area.any():
            raise UserError(f"{recipe.area}: got areas from {area.min():.3g} to {area.max():.3g}, expected m² above 0; mend it")
        places = replace(places, area=area, known=places.known | {"area"})
    return places


def freed(places: Places, quantity: Quantity, told: list[str]) -> Places:
    """The texels whose light can be freed of the albedo, if that is in it.

    Raises:
      UserError: the albedo is not known, or 0 everywhere.
    """
    if not quantity.albedo:
        return places
    if "albedo" not in places.known:
        raise UserError(
            f"--quantity: got {quantity.told}, but no albedo to divide by; give --albedo FILE, or take --quantity exitant"
        )
    fine = divisible(places.albedo)
    if not fine.any():
        raise UserError("--albedo: got 0 everywhere, expected what the light was multiplied with; mend it")
    if not fine.all():
        told.append(f"{int((~fine).sum())} texels have an albedo near 0 in some channel: their light cannot be freed of it")
    return places.kept(fine)


def _on_mesh(recipe: Recipe, folder: Path, shape: tuple[int, int]) -> Places:
    if shape[0] != shape[1]:
        raise UserError(f"--geometry: got maps of {shape[1]} x {shape[0]}, expected square lightmaps; leave the mesh out")
    scene = load_lightmapped(folder / recipe.geometry)
    assert scene.lightmap is not None
    uv = np.clip(scene.lightmap[scene.triangles], 0, 1)
    atlas = measured_atlas(scene, uv, np.zeros(len(uv), np.int32), shape[0])
    lapped = int((atlas.coverage > _LAPPED).sum())
    if lapped:
        raise UserError(
            f"{recipe.geometry}: got lightmap coordinates that overlap in {lapped} texels, expected each once; unwrap it anew"
        )
    single = {
        name: np.asarray(getattr(atlas, name), np.float32) for name in ("position", "normal", "albedo", "area", "coverage")
    }
    known = frozenset(("position", "area", "mesh", "albedo"))
    # Light is looked up between texels: where charts touch, that of one shows on the other.
    apart = charts_apart(scene, shape[0], 1)
    bleeds = (
        f"charts of {recipe.geometry} are not one texel apart at this size: light bleeds over their edges; unwrap with a margin"
    )
    notes = () if apart else (bleeds,)
    return Places(atlas.slot >= 0, **single, corners=scene.corners, uv=uv, known=known, notes=notes)


def _in_picture(recipe: Recipe, reader: "_Maps", lit: Bool[np.ndarray, "height width"]) -> Places:
    """Texels that count: all where a mask is given, else those of the G-buffer, else those that are ever lit."""
    covered, known = lit, set[str]()
    if recipe.position:
        if not recipe.normal:
            raise UserError("--position: got no --normal beside it, expected both; add it, or leave the positions out")
        position, normal = reader.read("position", recipe.position), reader.read("normal", recipe.normal)
        covered = np.abs(normal).max(2) > 0
        known |= {"position", "area"}
    elif recipe.normal:
        raise UserError("--normal: got no --position beside it, expected both; add it, or leave the normals out")
    else:
        rows, columns = np.indices(lit.shape, np.float32)
        position = np.stack([columns + 0.5, rows + 0.5, np.zeros_like(rows)], 2)
        normal = np.broadcast_to(np.array([0, 0, 1], np.float32), position.shape)
    if recipe.mask and not recipe.position:
        covered = np.ones_like(lit)
    if not covered.any():
        raise UserError("maps: got no light and no mask, expected some texel that counts; check the maps")
    area = _areas(position, covered) if recipe.position else np.ones(covered.shape, np.float32)
    ones = np.ones((int(covered.sum()), 3), np.float32)
    return Places(
        covered,
        position[covered],
        unit(normal[covered].astype(np.float64)).astype(np.float32),
        ones,
        area[covered],
        ones[:, 0],
        np.zeros((0, 3, 3)),
        None,
        frozenset(known),
    )


def _areas(
    position: Float32[np.ndarray, "height width 3"], covered: Bool[np.ndarray, "height width"]
) -> Float32[np.ndarray, "height width"]:
    """m² of texels by the distances to their neighbours; across the edge of a chart the nearer one counts."""
    place = np.where(covered[..., None], position.astype(np.float64), np.nan)
    edges = []
    for axis in (0, 1):
        step = np.diff(place, axis=axis)
        gap = np.full_like(np.take(step, [0], axis) if step.shape[axis] else np.take(place, [0], axis), np.nan)
        sides = np.stack([np.concatenate(pair, axis) for pair in ((gap, step), (step, gap))])
        size = np.linalg.norm(sides, axis=3)
        size = np.where(np.isnan(size), np.inf, size)
        chosen = np.take_along_axis(sides, size.argmin(0)[None, ..., None], 0)[0]
        edges.append(np.nan_to_num(chosen))
    area = np.linalg.norm(np.cross(*edges), axis=2)
    usual = float(np.median(area[covered & (area > 0)])) if (covered & (area > 0)).any() else 1.0
    return np.where(covered & (area == 0), usual, area).astype(np.float32)


@dataclass(frozen=True)
class _Maps:
    folder: Path
    shape: tuple[int, int]

    def read(self, kind: str, name: str, colour: str = "") -> np.ndarray:
        image = read_picture(self.folder / name, Wanted(kind, colour=colour)).light
        if image.shape[:2] != self.shape:
            height, width = self.shape
            raise UserError(
                f"{name}: got {image.shape[1]} x {image.shape[0]} pixels, expected {width} x {height} as the maps; make it fit"
            )
        return image


def stored_scene(data: Dataset) -> Scene | None:
    """The mesh that a dataset keeps, as a scene to look at; None where an import brought none."""
    if data.lacks("mesh"):
        return None
    corners = data.occluders
    normals = unit(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]))
    return Scene(
        data.description["scene"]["name"],
        corners.reshape(-1, 3),
        np.arange(3 * len(corners), dtype=np.int32).reshape(-1, 3),
        np.repeat(normals, 3, axis=0),
        np.zeros(len(corners), np.int32),
        (Material("imported", (UNSAID,) * 3),),
    )


def digest(places: Places) -> dict[str, Any]:
    """Facts of the texels for a description."""
    height, width = places.covered.shape
    return {"resolution": max(height, width), "padding": 1, "height": height, "width": width}
