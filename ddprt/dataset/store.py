"""The dataset on disk: EXR pairs, a description, and a manifest that only names whole files.

A file is written under a temporary name, synced and renamed; then its line (name, bytes, sha256) is appended to
`manifest.jsonl`. What the manifest names is whole, what it does not name does not count: an interrupted bake
goes on from there.
"""

import json
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from ddprt.axes import Bool, Float32, Float64
from ddprt.dataset.light_files import lit
from ddprt.dataset.manifest import Manifest, layer_name, map_name
from ddprt.dataset.pack import Pack, Shelf, Stored, remove_packs
from ddprt.errors import UserError
from ddprt.files import make_folder, read_tensors, write_text
from ddprt.lights import Lighting, parse_lighting
from ddprt.sampling.points import Samples
from ddprt.scene.atlas import Atlas
from ddprt.scene.exr import exposure_for, read_exr, write_exr
from ddprt.scene.fog import Fog
from ddprt.scene.holes import Holes
from ddprt.scene.mesh import Scene
from ddprt.scene.viewpoint import Viewpoint
from ddprt.transport.translucency import exitant_texels

SCHEMA = 1
_GBUFFER = ("position", "normal", "geometric_normal", "albedo", "area", "coverage")
CONSTANT = "constant.exr"
"""Light of what glows in the scene, where a plan calls for it."""
ATLAS_FILES = tuple(f"atlas/{name}.exr" for name in _GBUFFER)


@dataclass(frozen=True, eq=False)
class Dataset:
    """A baked (or imported) dataset, read on demand; make one with `ddprt.bake` or `ddprt.open_dataset`.

    Attributes:
      folder: where it lies.
      description: contents of dataset.json.
      keep_alive: whatever must live as long as the dataset (a temporary folder).
    """

    folder: Path
    description: dict[str, Any]
    keep_alive: Any = field(default=None, repr=False, compare=False)

    @cached_property
    def lightings(self) -> tuple[Lighting, ...]:
        """All lightings, by index."""
        return tuple(
            parse_lighting(lit(entry["lights"], self.folder), f"lightings[{i}]") if entry["lights"] or not self.imported else ()
            for i, entry in enumerate(self.description["lightings"])
        )

    @property
    def imported(self) -> dict[str, Any]:
        """Where light that ddprt did not bake comes from, and what it lacks; empty for what it baked."""
        return dict(self.description.get("imported", {}))

    def lacks(self, what: str) -> bool:
        """Whether an import brought no "direct" or "noise" maps, or no "mesh"."""
        return what in self.imported.get("lacks", ())

    def split(self, name: str) -> list[int]:
        """Indices of the lightings of "train", "validation" or "test"."""
        return [index for index, entry in enumerate(self.description["lightings"]) if entry["split"] == name]

    @property
    def resolution(self) -> int:
        """Texels per side."""
        return int(self.description["atlas"]["resolution"])

    @cached_property
    def gbuffer(self) -> dict[str, Float32[np.ndarray, "texels channels"]]:
        """Position, normal, geometric_normal, albedo, area and coverage of the covered texels."""
        images = {name: read_exr(self.folder / "atlas" / f"{name}.exr")[0] for name in _GBUFFER}
        covered = images["coverage"][..., 0] > 0
        values = {name: image[covered] for name, image in images.items()}
        for name in _GBUFFER:
            _refuse_odd(self.folder / "atlas" / f"{name}.exr", values[name], signed="normal" in name or name == "position")
        return values

    @cached_property
    def covered(self) -> Bool[np.ndarray, "height width"]:
        """Which texels carry light; arrays over texels run through them row by row."""
        return read_exr(self.folder / "atlas" / "coverage.exr")[0][..., 0] > 0

    @property
    def area(self) -> Float64[np.ndarray, " texels"]:
        """World area of the covered texels, m²."""
        return self.gbuffer["area"][:, 0].astype(np.float64)

    @cached_property
    def samples(self) -> Samples:
        """Where direct light was measured, all supersamples in progressive order."""
        tensors = read_tensors(self.folder / "points.safetensors")
        spacing, depth = float(tensors["spacing"][0]), float(tensors.get("depth", np.zeros(1))[0])
        return Samples.read(tensors, spacing, depth)

    @cached_property
    def occluders(self) -> Float64[np.ndarray, "triangles 3 3"]:
        """Triangle corners, metres: what casts shadows."""
        return read_tensors(self.folder / "scene.safetensors")["corners"]

    @cached_property
    def uv(self) -> Float64[np.ndarray, "triangles 3 2"] | None:
        """Lightmap coordinates of these corners, origin top-left; None in bakes of older versions."""
        return read_tensors(self.folder / "scene.safetensors").get("uv")

    @cached_property
    def exitant(self) -> Bool[np.ndarray, " texels"] | None:
        """Texels that hold all light that leaves them, not what arrives; None where none do.

        Raises:
          UserError: the description names such materials, and what is kept of the scene knows no such texels.
        """
        path = self.folder / "scene.safetensors"
        found = read_tensors(path).get("exitant") if "exitant" in self.description else None
        if "exitant" in self.description and (found is None or found.shape != (int(self.covered.sum()),)):
            raise UserError(
                f"{path}: got {'none' if found is None else len(found)} exitant texels, expected one entry for each covered "
                "texel, since dataset.json names exitant materials; bake it again"
            )
        return found.astype(bool) if found is not None and found.any() else None

    def shaded(self, indices: Sequence[int]) -> Float32[np.ndarray, "lightings texels 3"]:
        """Direct light that surfaces scatter where it falls, W/m²: the maps, and 0 where all that leaves counts as indirect.

        It is 0 too where an import brought no maps of it.
        """
        if self.lacks("direct"):
            return np.zeros((len(indices), int(self.covered.sum()), 3), np.float32)
        values = self.maps("direct", indices)
        if self.exitant is not None:
            values[:, self.exitant] = 0
        return values

    @cached_property
    def holes(self) -> Holes | None:
        """Where rays pass through these triangles; None where they nowhere do.

        Raises:
          UserError: the masks do not fit the triangles.
        """
        path = self.folder / "scene.safetensors"
        tensors = read_tensors(path)
        try:
            return Holes.read(tensors, len(tensors["corners"]))
        except ValueError as error:
            raise UserError(f"{path}: {error}; bake it again") from None

    @cached_property
    def fog(self) -> Fog | None:
        """What light passes on its way; None for clear air.

        Raises:
          UserError: it is none that can be.
        """
        given = self.description.get("fog")
        return None if given is None else Fog.of(given, f"{self.folder / 'dataset.json'}: fog")

    @property
    def viewpoint(self) -> Viewpoint | None:
        """From where the scene's maker would have it seen; None where nobody says. Raises UserError where it is damaged."""
        given = self.description.get("viewpoint")
        return None if given is None else Viewpoint.of(given, f"{self.folder / 'dataset.json'}: viewpoint")

    def maps(self, kind: str, indices: Sequence[int]) -> Float32[np.ndarray, "lightings texels 3"]:
        """Lightmaps of the covered texels in W/m²; kind is "direct", "indirect" or (held-out lightings) "noise"."""
        if kind == "indirect":
            pack = self._shelf.find([map_name(kind, index) for index in indices])
            if isinstance(pack, Pack):
                return pack.read(indices)
        if self.lacks(kind):
            raise UserError(f"{self.folder}: got no {kind} maps, since the dataset was imported without them; do without")
        values = np.empty((len(indices), int(self.covered.sum()), 3), np.float32)
        for row, index in enumerate(indices):
            path = self.folder / map_name(kind, index)
            values[row] = _light(*self._stored(path))[self.covered]
            _refuse_odd(path, values[row], signed=kind == "noise")
        return values

    def packed(self) -> Pack | None:
        """The indirect maps as one file, which is made where it is missing or older than they are.

        Returns:
          None where it cannot be made, which is said once, as a `Doubt`; `maps` then reads the maps one by one.
        Raises:
          UserError: a map that cannot be read, or holds what is no light.
        """

        def read(name: str) -> Stored:
            image, exposure = self._stored(self.folder / name)
            _refuse_odd(self.folder / name, _light(image, exposure)[self.covered])
            return image, exposure

        return self._shelf.fill([map_name("indirect", i) for i in range(len(self.lightings))], self.covered, read)

    @cached_property
    def constant(self) -> Float32[np.ndarray, "texels 3"] | None:
        """Irradiance of emissive surfaces, W/m², in no other map of the dataset; None where none was baked."""
        if not _glows(self.description):
            return None
        path = self.folder / CONSTANT
        values = _light(*self._stored(path))[self.covered]
        _refuse_odd(path, values)
        return values

    @cached_property
    def _shelf(self) -> Shelf:
        def sources() -> dict[str, dict[str, Any]]:
            names = ["atlas/coverage.exr", *(map_name("indirect", i) for i in range(len(self.lightings)))]
            entries = Manifest(self.folder).entries
            return {name: entries[name] for name in names} if all(name in entries for name in names) else {}

        return Shelf(self.folder, "indirect", sources)

    def _stored(self, path: Path) -> Stored:
        image, exposure = _read_stored(path)
        if image.shape != (*self.covered.shape, 3):
            raise UserError(f"{path}: got a map of shape {image.shape}, expected {(*self.covered.shape, 3)}; bake it again")
        return image, exposure

    def measured(self, indices: Sequence[int]) -> Float32[np.ndarray, "lightings samples 3"]:
        """Direct irradiance at all samples, W/m²."""
        paths = [self.folder / map_name("measured", index) for index in indices]
        rows = [read_tensors(path)["irradiance"] for path in paths]
        for path, row in zip(paths, rows, strict=True):
            _refuse_odd(path, row)
        return np.stack(rows) if rows else np.empty((0, 0, 3), np.float32)

    def values(self, indices: Sequence[int], points: int, quantity: str) -> Float32[np.ndarray, "lightings points 3"]:
        """What an engine measures: supersamples averaged into the nearest of the first `points` samples.

        Args:
          indices: lightings.
          points: how many; at most as many as there are samples.
          quantity: "radiosity" (albedo times irradiance) or "irradiance", W/m².
        """
        return average_into_points(self.measured(indices), self.samples, points, quantity)


def average_into_points(
    irradiance: Float32[np.ndarray, "lightings samples 3"], samples: Samples, points: int, quantity: str
) -> Float32[np.ndarray, "lightings points 3"]:
    """Supersampled irradiance to one value per point; see `Dataset.values`."""
    home = samples.nearest_point(points)
    weighted = irradiance * samples.albedo.astype(np.float32) if quantity == "radiosity" else irradiance
    # Sums in the order of the samples: a product of matrices would depend on the number of threads.
    start = np.searchsorted(np.sort(home), np.arange(points))
    share = (1 / np.bincount(home)).astype(np.float32)  # taken before the sum, which might be too much for float32
    return np.add.reduceat((weighted * share[home, None])[:, np.argsort(home, kind="stable")], start, axis=1)


def open_dataset(folder: str | Path) -> Dataset:
    """Opens a dataset folder.

    Raises:
      UserError: missing, damaged, of another schema, or not finished.
    """
    folder = Path(folder)
    dataset = Dataset(folder, read_description(folder))
    named = set(Manifest(folder).entries)
    missing = [name for name in expected_files(dataset.description) if name not in named]
    if missing:
        raise UserError(
            f"{folder}: got {len(missing)} files missing (first {missing[0]}), expected a finished bake; run it again to go on"
        )
    return dataset


def read_description(folder: Path) -> dict[str, Any]:
    """Contents of dataset.json.

    Raises:
      UserError: missing, not JSON, or another schema.
    """
    path = folder / "dataset.json"
    try:
        description = json.loads(path.read_text("utf-8"))
        schema = description["schema"]
    except OSError as error:
        raise UserError(f"{path}: got {error.strerror or error}, expected a dataset; bake one first") from None
    except (ValueError, KeyError, TypeError):
        raise UserError(f"{path}: not a dataset description; delete the folder and bake again") from None
    if schema != SCHEMA:
        raise UserError(f"{path}: got schema {schema}, expected {SCHEMA}; bake again with this version")
    return dict(description)


def expected_files(description: dict[str, Any]) -> list[str]:
    """Names of all files of a finished dataset."""
    names = ["scene.safetensors", "points.safetensors", *ATLAS_FILES, *([CONSTANT] if _glows(description) else [])]
    lacks = description.get("imported", {}).get("lacks", ())
    for index, entry in enumerate(description["lightings"]):
        kinds = ["direct", "measured", "indirect", *(["noise"] if entry["split"] == "test" else [])]
        names += [map_name(kind, index) for kind in kinds if kind not in lacks]
    for part in description.get("layers", []):
        layer = part["name"]
        names += [layer_name(layer, "places"), *([layer_name(layer, "constant")] if part.get("constant") else [])]
        for index, entry in enumerate(description["lightings"]):
            names += [layer_name(layer, index, kind) for kind in ("light", "noise")[: 1 + (entry["split"] == "test")]]
    return names


def _glows(description: dict[str, Any]) -> bool:
    return any(entry["called"] for entry in description.get("plan", ()) if entry["name"] == "emission")


def write_map(path: Path, image: Float32[np.ndarray, "height width 3"]) -> None:
    """A lightmap as half floats under a power-of-two exposure: value = stored * 2**exposure."""
    if not np.isfinite(image).all():
        raise UserError(
            f"{path.name}: got light past the range of float32; lower the intensities or keep lamps off the surfaces"
        )
    # The brightest value goes to the top of the halves' range, so that what is 2^29 times fainter keeps all its bits.
    exposure = exposure_for(float(np.abs(image).max())) - 15
    attributes = {"ddprt_exposure": str(exposure), "ddprt_quantity": "irradiance", "ddprt_unit": "W/m2"}
    write_exr(path, np.ldexp(image, -exposure), half=True, attributes=attributes)


def read_map(path: Path) -> Float32[np.ndarray, "height width 3"]:
    """The lightmap that `write_map` wrote, W/m².

    Raises:
      UserError: missing or damaged.
    """
    return _light(*_read_stored(path))


def _read_stored(path: Path) -> Stored:
    image, attributes = read_exr(path)
    try:
        exposure = int(attributes.get("ddprt_exposure", "0"))
        np.ldexp(np.float32(0), exposure)
    except (ValueError, OverflowError):
        raise UserError(
            f"{path}: got exposure {attributes['ddprt_exposure']!r}, expected a whole number; bake it again"
        ) from None
    return image, exposure


def _light(stored: Float32[np.ndarray, "*places"], exposure: int) -> Float32[np.ndarray, "*places"]:
    """Stored values in W/m²."""
    with np.errstate(over="ignore"):  # what becomes infinite is refused where light is read
        return np.ldexp(stored, exposure)


def write_atlas(folder: Path, atlas: Atlas, manifest: Manifest) -> None:
    """The G-buffer as float EXRs, 0 where nothing is covered."""
    for name in _GBUFFER:
        values = np.asarray(getattr(atlas, name), np.float32)
        write_plane(folder, name, atlas.image(values), manifest)


def write_plane(folder: Path, name: str, image: Float32[np.ndarray, "height width *channels"], manifest: Manifest) -> None:
    """One picture of the G-buffer."""
    write_exr(folder / "atlas" / f"{name}.exr", image.reshape(*image.shape[:2], -1))
    manifest.add(f"atlas/{name}.exr")


def scene_tensors(scene: Scene, atlas: Atlas) -> dict[str, np.ndarray]:
    """What a dataset keeps of a scene: what casts shadows, and where it lies on the lightmap."""
    holes, exitant = Holes.of(scene), exitant_texels(scene, atlas)
    made_of = scene.strand_material
    leaving = {"exitant": exitant} if exitant.any() or (made_of and made_of.fibre) else {}  # strands: what lamps make is added
    return {"corners": scene.corners, "uv": atlas.uv, **leaving, **(holes.tensors if holes else {})}


def write_description(folder: Path, description: dict[str, Any]) -> None:
    """dataset.json, whole or not at all."""
    make_folder(folder)
    write_text(folder / "dataset.json", json.dumps(description, indent=1) + "\n")


def discard(folder: Path) -> None:
    """Removes what a bake wrote into a folder, and the packs made of it; what else lies there stays."""
    remove_packs(folder)
    names = list(Manifest(folder).entries)
    for name in (*names, "manifest.jsonl", "dataset.json"):
        (folder / name).unlink(missing_ok=True)
    for part in {folder / name for name in names}:
        with suppress(OSError):  # the folder itself, or one that is not empty
            part.parent.rmdir()


def _refuse_odd(path: Path, values: np.ndarray, *, signed: bool = False) -> None:
    """Stops at the first file with values that no light, area or albedo has."""
    if values.size and not (np.isfinite(values).all() and (signed or values.min() >= 0)):
        got = "NaN or infinity" if not np.isfinite(values).all() else f"negative values (down to {values.min():.3g})"
        raise UserError(f"{path}: got {got}, expected finite values, 0 or more; bake it again or mend its source")
