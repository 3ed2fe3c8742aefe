"""From pictures to a dataset: every file is read twice, once to be judged and once to be written."""

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from ddprt import __version__
from ddprt.axes import Float32
from ddprt.dataset import store
from ddprt.dataset.importers import agreement
from ddprt.dataset.importers.light_positions import white_ball
from ddprt.dataset.importers.pictures import Picture, Wanted, no_negatives, read_picture
from ddprt.dataset.importers.places import Places, digest, find_places, freed
from ddprt.dataset.importers.points import Chosen, choose_points, nowhere
from ddprt.dataset.importers.quantities import QUANTITIES, Quantity, irradiance
from ddprt.dataset.importers.recipe import Recipe
from ddprt.dataset.importers.sources import Shots, find_shots
from ddprt.dataset.light_files import kept
from ddprt.dataset.manifest import Manifest, map_name
from ddprt.dataset.store import Dataset
from ddprt.errors import UserError
from ddprt.files import alone_in, sha256, write_tensors
from ddprt.progress import Progress
from ddprt.sampling.points import Samples
from ddprt.transport.embree import Tracer
from ddprt.transport.measure import measure

_CHECKED = 3  # lightings whose direct light is traced again
_UNMEASURED = {
    "texels": "this model measures texels of imported maps, and there is no mesh that could cast shadows; pass measured values "
    "to predict, or import with --geometry",
    "vectors": "this model's measured values were imported without a place; pass measured values to predict",
}


def import_dataset(recipe: Recipe, folder: Path, out: Path, progress: Progress) -> Dataset:
    """Makes a dataset of what others rendered or photographed.

    An import that was interrupted starts anew; a finished one of the same recipe and files is kept.

    Args:
      recipe, folder: what is where.
      out: folder of the dataset.
      progress: is told what was found, assumed and left out.
    Raises:
      UserError: anything that is missing, damaged or does not fit together, or another dataset in the folder.
    """
    shots = find_shots(recipe, folder)
    source = _digest(recipe, folder, shots)
    with alone_in(out):
        if (out / "dataset.json").exists():
            there = store.read_description(out)
            if there.get("imported", {}).get("source") != source:
                raise UserError(f"{out}: holds another dataset; choose another --out, or delete that folder")
            if not _lacking(out, there) and not Manifest(out).damaged():
                progress.say(f"{out}: imported already")
                return Dataset(out, there)
            store.discard(out)
        (out / "manifest.jsonl").unlink(missing_ok=True)
        return _Import(recipe, folder, shots, out, progress).run(source)


@dataclass
class _Import:
    recipe: Recipe
    folder: Path
    shots: Shots
    out: Path
    progress: Progress
    notes: list[str] = field(default_factory=list)

    def run(self, source: str) -> Dataset:
        shape, lit, quantity, glow = self._judge()
        for line in self.shots.notes:
            self._doubt(line)
        self._note(f"quantity: {quantity.told}")
        places = freed(find_places(self.recipe, self.folder, shape, lit), quantity, self.notes)
        if not glow[places.covered].any():
            turned = "; they look upside down: row 0 of a map is its top" if glow[::-1][places.covered].any() else ""
            raise UserError(
                f"--indirect: got maps that are black at all {len(places.area)} texels that count, expected light to learn; "
                f"look at the mask, the lightmap coordinates and the way up{turned}"
            )
        for line in places.notes:
            self._doubt(line)
        chosen, samples, corners, why = self._points(places)
        self._note(f"{len(places.area)} texels of {shape[1]} x {shape[0]}, {len(samples.position)} measured values each")
        unknown = [name for name in ("position", "area", "albedo", "mesh") if name not in places.known]
        if unknown:
            self._note(f"not known, and done without: {', '.join(unknown)}")
        if not all(self.shots.lightings):
            self._note("no lights: methods that answer from lights have nothing to look at")
        description = self._description(source, places, samples, quantity, why, meshed=corners is places.corners)
        store.write_description(self.out, description)
        manifest = Manifest(self.out)
        self._write_places(manifest, places, samples, corners, quantity)
        self._write_light(manifest, places, chosen, samples, corners, quantity)
        if missing := _lacking(self.out, description):
            raise UserError(f"{self.out}: got {missing[0]} missing at the end, expected all files; import again")
        return Dataset(self.out, description)

    def _note(self, line: str) -> None:
        self.notes.append(line)
        self.progress.say(line)

    def _doubt(self, line: str) -> None:
        self.notes.append(line)
        self.progress.warn(line)

    def _judge(self) -> tuple[tuple[int, int], np.ndarray, Quantity, np.ndarray]:
        """Reads every picture once: size, colour, sign, what it holds, which texels are ever lit, which indirectly."""
        first: Picture | None = None
        colours, quantities, lit, dark, coarse = set[str](), set[str](), np.zeros((0, 0), bool), 0, False
        alpha: np.ndarray | None = None
        glow = lit
        with self.progress.stage("read", len(self.shots.files)) as stage:
            for kind, path in self._all():
                picture = read_picture(path, self._wanted(kind))
                if first is None:
                    first, lit = picture, np.zeros(picture.light.shape[:2], bool)
                    glow = lit.copy()
                if picture.light.shape[:2] != lit.shape:
                    got, expected = (f"{shape[1]} x {shape[0]}" for shape in (picture.light.shape, lit.shape))
                    raise UserError(f"{path}: got {got} pixels, expected {expected} as the first picture; make all of one size")
                light = self._positive(path, picture)
                lit |= light.max(2) > 0
                glow |= (light.max(2) > 0) & (kind == "indirect")
                if picture.alpha is not None:
                    alpha = picture.alpha > 0 if alpha is None else alpha | (picture.alpha > 0)
                dark += kind == "indirect" and not light.any()
                coarse |= picture.coarse
                colours.add(f"{kind} {f'layer {picture.layer} ' if picture.layer else ''}{picture.colour}")
                quantities.add(picture.quantity)
                stage.advance()
        if dark == len(self.shots.indirect):
            raise UserError("--indirect: got black pictures alone, expected light to learn; check the files and --channels")
        for line in sorted(colours):
            self._note(f"colours: {line}")
        if coarse:
            self.progress.warn("pictures of 8 bits a channel are taken as sRGB: dark places are coarse, bright ones cut off")
        if dark:
            self.progress.warn(f"{dark} of {len(self.shots.indirect)} pictures are black")
        counts = lit if alpha is None or not alpha.any() else alpha
        return lit.shape, counts, self._quantity(quantities), glow

    def _quantity(self, said: set[str]) -> Quantity:
        if self.recipe.quantity != "auto":
            return QUANTITIES[self.recipe.quantity]
        if self.shots.kind == "photographs":
            return QUANTITIES["exitant"]
        known = said - {""}
        if len(said) > 1 or not known <= set(QUANTITIES):
            raise UserError(
                f"--quantity: got pictures that say {' and '.join(sorted(name or 'nothing' for name in said))}, expected one "
                f"of {', '.join(QUANTITIES)}; say which"
            )
        if not known:
            self.progress.warn("no file says what it holds: taken as irradiance E in W/m²; say otherwise with --quantity")
        return QUANTITIES[next(iter(known), "irradiance")]

    def _all(self) -> list[tuple[str, Path]]:
        direct, indirect = self.shots.direct or (), self.shots.indirect
        return [*(("indirect", path) for path in indirect), *(("direct", path) for path in direct)]

    def _wanted(self, kind: str) -> Wanted:
        own = {"direct": self.recipe.direct_channels, "indirect": self.recipe.indirect_channels}[kind]
        return Wanted(kind, own or self.recipe.channels, self.recipe.colour)

    def _positive(self, path: Path, picture: Picture) -> Float32[np.ndarray, "height width 3"]:
        # What lies outside of Rec.709 is negative there, and no fault of the picture.
        other = "linear-rec709" not in picture.colour and "srgb" not in picture.colour
        return no_negatives(path, picture.light, clip=self.recipe.clip or other)

    def _light(
        self, kind: str, path: Path, places: Places, quantity: Quantity, step: int = 1
    ) -> Float32[np.ndarray, "texels 3"]:
        """Light of the texels; `step` is -1 for that of the picture upside down."""
        light = self._positive(path, read_picture(path, self._wanted(kind)))[::step][places.covered]
        found = irradiance(light, quantity, places.albedo)
        if not np.isfinite(found).all():
            raise UserError(f"{path}: got light past the range of float32, expected W/m²; make it dimmer")
        return found

    def _points(self, places: Places) -> tuple[Chosen | None, Samples, np.ndarray, str]:
        """Texels to measure (if any), places of the values, what casts shadows on them, why none can be measured."""
        how = self.recipe.measure
        if how == "auto":
            how = "ball" if self.shots.kind == "photographs" else "texels"
        if how == "ball":
            if not all(self.shots.lightings):
                raise UserError("--measure: got ball, but no lights to shine on it, expected --lights; add them")
            if not self.recipe.points.isdigit() or int(self.recipe.points) < 1:
                raise UserError(f'--points: got "{self.recipe.points}", expected how many on the ball; give a number')
            self._note("measured: a white ball under the lights, of irradiance 1 W/m² where an .lp file gives none")
            return None, *white_ball(int(self.recipe.points), self.recipe.seed), ""
        if self.shots.measured is not None:
            return None, nowhere(self.shots.measured.shape[1]), places.corners, _UNMEASURED["vectors"]
        chosen = choose_points(self.recipe.points, self.folder, places, self.recipe.seed)
        self._note(f"measured: {'the photograph' if self.shots.direct is None else 'direct light'} at texels")
        can = len(places.corners) > 0 and self.shots.direct is not None
        return chosen, chosen.samples, places.corners, "" if can else _UNMEASURED["texels"]

    def _description(
        self, source: str, places: Places, samples: Samples, quantity: Quantity, why: str, *, meshed: bool
    ) -> dict[str, Any]:
        name = self.recipe.name or self.folder.resolve().name
        lacks = [
            "noise",
            *(["direct"] if self.shots.direct is None else []),
            *([] if meshed and len(places.corners) else ["mesh"]),
        ]
        known = {"known": sorted(places.known), "lacks": lacks, "notes": list(self.notes)}
        kind = next(key for key, value in QUANTITIES.items() if value == quantity)
        return {
            "schema": store.SCHEMA,
            "ddprt": __version__,
            "imported": {"source": source, "kind": self.shots.kind, "quantity": kind, "unmeasured": why, **known},
            "scene": {"name": name, "digest": source, "notes": []},
            "atlas": digest(places),
            "seed": self.recipe.seed,
            "transport": {"integrator": "imported"},
            "placing": {"on": "imported maps" if meshed else "white ball", "file": ""},
            "quantity": "irradiance",
            **({"exitant": ["imported"]} if quantity.exitant else {}),
            "unit": "W/m2",
            "points": {"count": len(samples.position), "digest": samples.digest},
            "plan": [],
            "lightings": [
                {"name": name, "split": split, "lights": kept(lighting, self.out)}
                for name, split, lighting in zip(self.shots.names, self.shots.splits, self.shots.lightings, strict=True)
            ],
        }

    def _write_places(
        self, manifest: Manifest, places: Places, samples: Samples, corners: np.ndarray, quantity: Quantity
    ) -> None:
        tensors = {"position": samples.position, "normal": samples.normal, "albedo": samples.albedo}
        write_tensors(self.out / "points.safetensors", {**tensors, "spacing": np.array([samples.spacing])})
        uv = {} if places.uv is None or len(places.uv) != len(corners) else {"uv": places.uv}
        exitant = {"exitant": np.ones(len(places.area), bool)} if quantity.exitant else {}
        write_tensors(self.out / "scene.safetensors", {"corners": corners, **uv, **exitant})
        for name in ("points.safetensors", "scene.safetensors"):
            manifest.add(name)
        for name in ("position", "normal", "albedo", "area", "coverage"):
            store.write_plane(self.out, name, places.image(getattr(places, name)), manifest)
        store.write_plane(self.out, "geometric_normal", places.image(places.normal), manifest)

    def _write_light(
        self,
        manifest: Manifest,
        places: Places,
        chosen: Chosen | None,
        samples: Samples,
        corners: np.ndarray,
        quantity: Quantity,
    ) -> None:
        given, direct = self.shots.measured, self.shots.direct
        ball = Tracer(corners) if chosen is None and given is None else None
        kept: list[np.ndarray] = []
        with self.progress.stage("write", len(self.shots.names)) as stage:
            for index, path in enumerate(self.shots.indirect):
                light = self._light("indirect", path, places, quantity)
                self._write(manifest, "indirect", index, places, light)
                shine = light
                if direct is not None:
                    shine = self._light("direct", direct[index], places, quantity)
                    self._write(manifest, "direct", index, places, shine)
                    kept += [shine] if len(kept) < _CHECKED else []
                if ball is not None:
                    lighting = self.shots.lightings[index]
                    values = measure(ball, lighting, samples.position, samples.normal, seed=0, index=index)
                elif given is not None:
                    values = given[index]
                else:
                    assert chosen is not None
                    values = shine[chosen.texel]
                write_tensors(self.out / map_name("measured", index), {"irradiance": values})
                manifest.add(map_name("measured", index))
                stage.advance()
        if kept and chosen is not None and len(places.corners) and all(self.shots.lightings):
            turned = [self._light("direct", path, places, quantity, -1) for path in (direct or ())[: len(kept)]]
            self._agreed(places, chosen.texel, kept, turned)

    def _agreed(self, places: Places, texel: np.ndarray, kept: Sequence[np.ndarray], turned: Sequence[np.ndarray]) -> None:
        words, fits = agreement.told(places, texel, self.shots.lightings[: len(kept)], np.stack(kept), np.stack(turned))
        self.progress.say(words) if fits else self.progress.warn(words)

    def _write(self, manifest: Manifest, kind: str, index: int, places: Places, light: np.ndarray) -> None:
        store.write_map(self.out / map_name(kind, index), places.image(light))
        manifest.add(map_name(kind, index))


def _lacking(out: Path, description: dict[str, Any]) -> list[str]:
    manifest = Manifest(out)
    return [name for name in store.expected_files(description) if not manifest.holds(name)]


def _digest(recipe: Recipe, folder: Path, shots: Shots) -> str:
    """Hash of all that an import is made from: another recipe or picture makes another dataset."""
    named = [recipe.lights, recipe.measured, recipe.albedo, recipe.mask, recipe.position, recipe.normal, recipe.area]
    named += [recipe.geometry, *([recipe.points] if not recipe.points.isdigit() else [])]
    files = [folder / name for name in named if name and (folder / name).is_file()]
    state = hashlib.sha256(json.dumps([recipe.model_dump(), shots.names]).encode())
    for path in (*files, *shots.files):
        state.update(sha256(path).encode())
    return state.hexdigest()[:16]
