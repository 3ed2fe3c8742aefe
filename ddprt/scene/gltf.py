"""glTF 2.0 in (.glb, .gltf): triangles and materials; what is not read is named once and ignored.

Base colour factors are linear and base textures sRGB, as the standard says, and their product is the albedo. Emission counts
as W/(m² sr). Blended surfaces are taken as cut out where their opacity is below a half. A volume that light gets into and that
scatters is a medium: its extinction is the volume's attenuation, its albedo what sends back the colour of multiple scattering
where it is thick; its surface is smooth, whatever the roughness. All textures of a material are looked up at one place, the
first one's: of another that has texture coordinates of its own the mean is taken, and said so. Colours of vertices are linear
factors on the albedo. A primitive without normals is flat. The second texture coordinates are kept as a lightmap layout.
"""

import warnings
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pygltflib

from ddprt.axes import Float, Float64, Int
from ddprt.scene.accessors import Container, open_gltf
from ddprt.scene.checks import UNSAID, checked
from ddprt.scene.gltf_cameras import seen_from
from ddprt.scene.gltf_nodes import Pose, placed
from ddprt.scene.gltf_primitive import colours_of, triangles_of
from ddprt.scene.gltf_samplers import wraps
from ddprt.scene.images import linear_image, plain_image
from ddprt.scene.material import Cutout, Emission, Gloss, Material, Subsurface
from ddprt.scene.mesh import Scene
from ddprt.scene.wrapping import unrolled

REFUSED = {
    "KHR_draco_mesh_compression": "export without Draco compression",
    "EXT_meshopt_compression": "export without meshopt compression",
    "KHR_meshopt_compression": "export without meshopt compression",
    "EXT_mesh_gpu_instancing": "export instances as nodes",
    "KHR_texture_basisu": "export textures as PNG or JPEG",
}
"""Extensions whose absence would lose geometry or textures, and the way out."""

_INDEX, _VOLUME, _SCATTER = "KHR_materials_ior", "KHR_materials_volume", "KHR_materials_volume_scatter"
_PASSING = {
    "KHR_materials_transmission": "transmissionFactor",
    "KHR_materials_diffuse_transmission": "diffuseTransmissionFactor",
}
_STRENGTH, _UNLIT, LIGHTS = "KHR_materials_emissive_strength", "KHR_materials_unlit", "KHR_lights_punctual"
UNDERSTOOD = (
    *("KHR_mesh_quantization", "KHR_texture_transform", "EXT_texture_webp", _STRENGTH),
    *(_INDEX, _VOLUME, _SCATTER, *_PASSING),
)
HARMLESS = ("KHR_materials_", "KHR_lights_", "KHR_xmp", "KHR_animation", "KHR_node_visibility")
"""May be required by a file and are still only ignored."""


def load_gltf(path: Path) -> Scene:
    """Read a glTF file's default scene into one mesh in world space.

    Args:
      path: a .glb, or a .gltf with its buffers and images embedded or beside it.
    Returns:
      The scene: metres, fronts as in the file (mirrored nodes keep theirs), one material per glTF material.
    Raises:
      UserError: cut short, an index out of range, compressed geometry. What else a damaged file leads to is raised as it comes;
        `load_scene` puts it into words.
    Reference: Khronos glTF 2.0 specification; KHR_mesh_quantization, KHR_texture_transform.
    """
    with warnings.catch_warnings():
        # pygltflib speaks by warnings; what matters in them is found and refused below.
        warnings.simplefilter("ignore")
        return Reader(open_gltf(path)).scene()


@dataclass
class _Part:
    """One primitive in world space; `lightmap` is its second set of texture coordinates, NaN where it has none."""

    positions: Float[np.ndarray, "vertices 3"]
    normals: Float[np.ndarray, "vertices 3"]
    uv: Float[np.ndarray, "vertices 2"]
    colour: Float[np.ndarray, "vertices 3"]
    lightmap: Float[np.ndarray, "vertices 2"]
    triangles: Int[np.ndarray, "triangles 3"]
    material: int


@dataclass
class Reader:
    """One reading of a file: as it stands, or in a pose of its animation.

    Attributes:
      file: what is read.
      pose: None leaves animations, skins and morph targets aside, and says so.
    """

    file: Container
    pose: Pose | None = None
    ignored: set[str] = field(default_factory=set)
    notes: list[str] = field(default_factory=list)
    images: dict[tuple[int, Any], np.ndarray] = field(default_factory=dict)

    def scene(self, *, numbered: bool = False) -> Scene:
        """The checked scene; `numbered` has each vertex' number in `positions` where texture coordinates were."""
        self._extensions()
        parts = self._all_parts()
        starts = np.cumsum([0, *[len(part.positions) for part in parts]])
        numbers = sorted({part.material for part in parts})
        materials = tuple(self._material(number) for number in numbers)
        self._lamps()
        still = (("animations", self.file.json.animations), ("skins", self.file.json.skins)) if self.pose is None else ()
        self.ignored.update(what for what, there in still if there)
        materials = tuple(
            self._rolled_out(material, number, [part for part in parts if part.material == number])
            for material, number in zip(materials, numbers, strict=True)
        )
        colour = np.concatenate([part.colour for part in parts])
        uv = np.concatenate([part.uv for part in parts]) if any(entry.textures for entry in materials) else None
        listed = [f"ignored in the file: {', '.join(sorted(self.ignored))}"] if self.ignored else []
        scene = checked(
            self.file.path.stem,
            np.concatenate([part.positions for part in parts]),
            np.concatenate([part.triangles + start for part, start in zip(parts, starts, strict=False)]),
            normals=np.concatenate([part.normals for part in parts]),
            material=np.concatenate([np.full(len(part.triangles), numbers.index(part.material)) for part in parts]),
            materials=materials,
            uv=np.stack([np.arange(starts[-1], dtype=np.float64)] * 2, 1) if numbered else uv,
            colour=colour if (colour != 1).any() else None,
            lightmap=self._lightmap(parts),
            notes=(*self.notes, *listed),
        )
        return seen_from(scene, self.file, placed(self.file, self.pose)) if self.file.json.cameras else scene

    def positions(self) -> Float64[np.ndarray, "vertices 3"]:
        """All vertices in world space, before any is dropped by the checks, metres."""
        return np.concatenate([part.positions for part in self._all_parts()])

    def _all_parts(self) -> list[_Part]:
        nodes = placed(self.file, self.pose)
        parts = [part for number, node, world in nodes if node.mesh is not None for part in self._parts(number, world)]
        if not parts:
            raise self.file.fault("got no triangles, expected a mesh in the file's scene; export at least one")
        return parts

    def _extensions(self) -> None:
        required, used = set(self.file.json.extensionsRequired or []), set(self.file.json.extensionsUsed or [])
        for name in sorted(required | used):
            if name in REFUSED:
                raise self.file.fault(f"got {name}, which is not read; {REFUSED[name]}")
            if name in required and name not in UNDERSTOOD and not name.startswith(HARMLESS):
                raise self.file.fault(f"got the required extension {name}, which is not read; export without it")
        self.ignored.update(used - set(UNDERSTOOD))

    def _parts(self, number: int, world: Float64[np.ndarray, "4 4"]) -> list[_Part]:
        parts = []
        for primitive in self.file.entry("meshes", self.file.entry("nodes", number).mesh).primitives:
            mode = 4 if primitive.mode is None else primitive.mode
            if mode in (0, 1, 2, 3):
                self.ignored.add("points and lines")
                continue
            parts.append(self._part(number, primitive, world))
        return parts

    def _part(self, number: int, primitive: Any, world: Float64[np.ndarray, "4 4"]) -> _Part:
        attributes = primitive.attributes
        if attributes.POSITION is None:
            raise self.file.fault("got a primitive without POSITION, expected places of vertices; export it again")
        positions = self.file.accessor(attributes.POSITION, 3)
        count = len(positions)
        triangles, left = triangles_of(self.file, primitive, count)
        if left:
            self.ignored.add("corners after the last whole triangle")
        flat, second = attributes.NORMAL is None, getattr(attributes, "TEXCOORD_1", None)
        normals = np.full((count, 3), np.nan) if flat else self._rows("NORMAL", attributes.NORMAL, 3, count)
        uv, colour = self._coordinates(primitive, count), self._colour(primitive, count)
        lightmap = np.full((count, 2), np.nan) if second is None else self._rows("TEXCOORD_1", second, 2, count)
        if self.pose is not None:
            as_modelled = positions
            positions, world = self.pose.shaped(number, primitive, positions, world)
            if positions is not as_modelled:  # the file's normals are of another shape: they are made anew
                normals = np.full((count, 3), np.nan)
        elif primitive.targets:
            self.ignored.add("morph targets")
        linear = world[:3, :3]
        mirrored = np.linalg.det(linear) < 0
        # The cofactors are the inverse transpose up to a factor, and exist where the inverse does not.
        cofactors = np.cross(np.roll(linear, -1, axis=0), np.roll(linear, -2, axis=0)) * (-1 if mirrored else 1)
        if flat:
            corner = triangles.ravel()
            positions, normals, uv, colour, lightmap = (rows[corner] for rows in (positions, normals, uv, colour, lightmap))
            triangles = np.arange(corner.size).reshape(-1, 3)
        return _Part(
            positions @ linear.T + world[:3, 3],
            normals @ cofactors.T,
            uv,
            colour,
            lightmap,
            triangles[:, ::-1] if mirrored else triangles,
            -1 if primitive.material is None else primitive.material,
        )

    def _coordinates(self, primitive: Any, count: int) -> Float[np.ndarray, "vertices 2"]:
        texture = None if primitive.material is None else _leading(self.file.entry("materials", primitive.material))
        if texture is None:
            return np.zeros((count, 2))
        number, angle, scale, offset = _placing(texture)
        name = f"TEXCOORD_{number}"
        accessor = getattr(primitive.attributes, name, None)
        if accessor is None:
            raise self.file.fault(f"got a texture but no {name}, expected texture coordinates; unwrap it or drop the texture")
        # As every viewer does; the listing in the extension's text has the sign the other way round (glTF issue 1563).
        turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
        return self._rows(name, accessor, 2, count) * scale @ turn.T + offset

    def _rows(self, name: str, number: int, width: int, count: int) -> Float64[np.ndarray, "count width"]:
        """An attribute, of which every vertex must have its row."""
        rows = self.file.accessor(number, width)
        if len(rows) != count:
            raise self.file.fault(f"got {len(rows)} rows of {name} for {count} vertices, expected as many; export it again")
        return rows

    def _colour(self, primitive: Any, count: int) -> Float64[np.ndarray, "vertices 3"]:
        """Factors on the albedo of each vertex; 1 where the file has none."""
        colour = colours_of(self.file, primitive)
        if colour is None:
            return np.ones((count, 3))
        if len(colour) != count:
            raise self.file.fault(f"got {len(colour)} colours for {count} vertices, expected as many; export it again")
        if (colour[:, 3:] != 1).any():
            self.ignored.add("opacity of vertex colours")
        if (colour[:, :3] > 1).any():
            self.notes.append("vertex colours above 1 are taken as 1")
        return np.minimum(colour[:, :3], 1.0)

    def _lamps(self) -> None:
        """Says where the file's lights can be had: a scene holds what stays still."""
        lamps = (self.file.json.extensions or {}).get(LIGHTS, {}).get("lights", [])
        if lamps:
            self.ignored.discard(LIGHTS)
            self.notes.append(f"{len(lamps)} light{'s' * (len(lamps) > 1)} in the file, to shine where lightings.file names it")

    def _lightmap(self, parts: list[_Part]) -> Float64[np.ndarray, "vertices 2"] | None:
        """Second texture coordinates of all vertices; None where no primitive has any, NaN where some have none."""
        lightmap = np.concatenate([part.lightmap for part in parts])
        return None if np.isnan(lightmap).all() else lightmap

    def _rolled_out(self, material: Material, number: int, parts: list[_Part]) -> Material:
        """The material with its textures as their samplers wrap them; moves the texture coordinates of its parts."""
        modes = {} if number < 0 or not material.textures else wraps(self.file, self.file.entry("materials", number))
        uv = np.concatenate([part.uv for part in parts])
        if not modes or not len(uv) or not np.isfinite(uv).all():
            return material
        changed = unrolled(material.textures, modes, uv)
        if changed is None:
            reach = np.abs(uv).max()
            self.notes.append(f'material "{material.name}": texture coordinates up to {reach:g} are too far to wrap: repeated')
            return material
        start = 0
        for part in parts:
            part.uv, start = changed[1][start : start + len(part.uv)], start + len(part.uv)
        return material.retextured(changed[0])

    def _material(self, number: int) -> Material:
        if number < 0:
            self.notes.append(f"no material on some triangles: albedo {UNSAID} assumed")
            return Material("none", (UNSAID,) * 3)
        entry = self.file.entry("materials", number)
        base = _base(entry)
        name = entry.name or f"material {number}"
        self.ignored.update(
            what for what, there in (("normal maps", entry.normalTexture), ("occlusion maps", entry.occlusionTexture)) if there
        )
        red, green, blue, alpha = (float(value) for value in base.baseColorFactor or [1.0] * 4)
        texture = None if base.baseColorTexture is None else self._image(base.baseColorTexture.index, linear_image)
        medium, unlit = self._subsurface(entry, name), _UNLIT in (entry.extensions or {})
        if unlit:
            self.ignored.discard(_UNLIT)
            self.notes.append(f'material "{name}" is unlit: taken as matt, lit as all others')
        return Material(
            name,
            (red, green, blue),
            texture,
            bool(entry.doubleSided),
            self._cutout(entry, name, alpha),
            self._emission(entry, name),
            None if medium or unlit else self._gloss(entry, name),
            medium,
        )

    def _subsurface(self, entry: Any, name: str) -> Subsurface | None:
        """The medium that fills it; None where light does not get in, or nothing inside scatters it."""
        extensions = entry.extensions or {}
        volume, passing = extensions.get(_VOLUME, {}), [extensions.get(key, {}).get(what, 0) for key, what in _PASSING.items()]
        if not volume.get("thicknessFactor", 0) or not any(passing):
            return None
        scatter, distance = extensions.get(_SCATTER), volume.get("attenuationDistance", np.inf)
        fading = -np.log(np.maximum(volume.get("attenuationColor", [1.0] * 3), 1e-6)) / distance
        if scatter is None or not (fading > 0).all():
            why = "no KHR_materials_volume_scatter" if scatter is None else "a channel that nothing dims"
            self.notes.append(f'material "{name}": a volume with {why} is not simulated; taken as opaque')
            return None
        g = float(scatter.get("scatterAnisotropy", 0.0))
        red, green, blue = (Subsurface.single_albedo(float(value), g) for value in scatter.get("multiscatterColor", [0.0] * 3))
        x, y, z = (1 / fading).tolist()
        return Subsurface((red, green, blue), (x, y, z), g, float(extensions.get(_INDEX, {}).get("ior", 1.5)))

    def _cutout(self, entry: Any, name: str, alpha: float) -> Cutout | None:
        """Its holes; None where it has none."""
        mode, texture = entry.alphaMode or "OPAQUE", _base(entry).baseColorTexture
        if mode not in ("OPAQUE", "MASK", "BLEND"):
            raise self.file.fault(f'got alphaMode "{mode}" of material "{name}", expected OPAQUE, MASK or BLEND; mend it')
        if mode == "OPAQUE":
            return None
        if mode == "BLEND":
            self.notes.append(f'material "{name}": blending is not simulated; taken as cut out where its opacity is below 0.5')
        cutoff = 0.5 if mode == "BLEND" or entry.alphaCutoff is None else float(entry.alphaCutoff)
        opacity = np.ones((1, 1), np.float32) if texture is None else self._image(texture.index, plain_image)[..., 3]
        opacity = opacity * np.float32(alpha)
        if cutoff > 1:  # as the standard says, nothing is that opaque
            opacity, cutoff = np.zeros((1, 1), np.float32), 1.0
        return Cutout(np.ascontiguousarray(opacity), cutoff) if opacity.min() < cutoff else None

    def _emission(self, entry: Any, name: str) -> Emission | None:
        strength = (entry.extensions or {}).get(_STRENGTH, {}).get("emissiveStrength", 1.0)
        colour = np.array(entry.emissiveFactor or [0.0] * 3) * strength
        if not colour.any():
            return None
        colour, texture = self._factored(entry, entry.emissiveTexture, colour, linear_image, slice(3), f'"{name}": emission')
        red, green, blue = colour.tolist()
        return Emission((red, green, blue), texture)

    def _gloss(self, entry: Any, name: str) -> Gloss:
        base = _base(entry)
        factors = np.array([1.0 if factor is None else factor for factor in (base.roughnessFactor, base.metallicFactor)])
        channels = slice(1, 3)  # green is roughness, blue metalness
        of = f'"{name}": metallic and roughness'
        factors, texture = self._factored(entry, base.metallicRoughnessTexture, factors, plain_image, channels, of)
        roughness, metallic = factors.tolist()
        return Gloss(roughness, metallic, texture=texture)

    def _factored(
        self, entry: Any, texture: Any, factor: np.ndarray, kind: Any, channels: slice, of: str
    ) -> tuple[np.ndarray, np.ndarray | None]:
        """A factor and its image, or the image's mean in the factor where that lies elsewhere than the first texture."""
        if texture is None:
            return factor, None
        image = np.ascontiguousarray(self._image(texture.index, kind)[..., channels])
        if _placing(texture) == _placing(_leading(entry)):
            return factor, image
        self.notes.append(f"material {of} texture has texture coordinates of its own: its mean is taken")
        return factor * image.mean((0, 1), dtype=np.float64), None

    def _image(self, number: int, kind: Any) -> np.ndarray:
        """An image of the file, decoded in one of two ways."""
        texture = self.file.entry("textures", number)
        webp = (texture.extensions or {}).get("EXT_texture_webp", {}).get("source")
        source = webp if webp is not None else texture.source
        if source is None:
            raise self.file.fault(f"got texture {number} without an image, expected PNG or JPEG; export textures as PNG")
        if (source, kind) in self.images:
            return self.images[source, kind]
        image = self.file.entry("images", source)
        try:
            data = bytes(self.file.view(image.bufferView)) if image.uri is None else self.file.uri(image.uri)
            if data[:6] == b"\xabKTX 2":
                raise self.file.fault(f"got image {source} as KTX2, which is not read; export textures as PNG")
            self.images[source, kind] = kind(data)
        except OSError as problem:
            why = str(problem).partition("<")[0].strip()  # Pillow adds an address
            raise self.file.fault(
                f"got image {source} that cannot be read ({why}), expected PNG or JPEG; export it again"
            ) from problem
        return self.images[source, kind]


def _base(material: Any) -> Any:
    return material.pbrMetallicRoughness or pygltflib.PbrMetallicRoughness()


def _leading(material: Any) -> Any:
    """The texture whose coordinates a material's others are looked up by; None where it has none."""
    base = _base(material)
    textures = (base.baseColorTexture, base.metallicRoughnessTexture, material.emissiveTexture)
    return next((texture for texture in textures if texture is not None), None)


def _placing(texture: Any) -> tuple[int, float, list[float], list[float]]:
    """Number of its texture coordinates, and how they are turned, scaled and moved."""
    change = (texture.extensions or {}).get("KHR_texture_transform", {})
    number = change.get("texCoord", texture.texCoord or 0)
    scale, offset = (
        [float(value) for value in change.get(key, default)] for key, default in (("scale", (1, 1)), ("offset", (0, 0)))
    )
    return number, float(change.get("rotation", 0.0)), scale, offset
