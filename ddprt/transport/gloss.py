"""Glossy surfaces on the way of light: where paths meet one, and what they carry on from there.

Only rays that hit such a surface come here. What leaves it depends on where it goes, so its vertices remember the direction
that the path came from, and each light is weighed by that; paths go on where the surface reflects.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from ddprt import warp
from ddprt.axes import Bool, Float32, Int, Int32
from ddprt.lights import Light
from ddprt.scene.material import Material, bilinear
from ddprt.scene.mesh import Scene
from ddprt.transport import ggx, weighing
from ddprt.transport.embree import Tracer, lifted
from ddprt.transport.glossiness import glossy
from ddprt.transport.walk import MAX_SURVIVAL, SURVIVAL, Vertices


@dataclass(frozen=True, eq=False)
class Lobes:
    """Glossy surfaces at some places, each seen from a direction.

    Attributes:
      frames: rows tangent, bitangent, normal.
      outgoing: unit directions that light is asked for in, in these frames.
      base: colour, linear Rec.709.
      gloss: roughness, metallic and the dielectric's reflectance.
    """

    frames: Float32[np.ndarray, "n 3 3"]
    outgoing: Float32[np.ndarray, "n 3"]
    base: Float32[np.ndarray, "n 3"]
    gloss: Float32[np.ndarray, "n 3"]

    def reflected(self, directions: Float32[np.ndarray, "n 3"]) -> Float32[np.ndarray, "n 3"]:
        """Radiance that goes out for each W/m², on a plane that faces it, from world directions; 1/sr."""
        return ggx.evaluate(self.outgoing, _to_local(directions, self.frames), self.base, self.gloss)

    def scattered(self, u: Float32[np.ndarray, "n 3"]) -> tuple[Float32[np.ndarray, "n 3"], Float32[np.ndarray, "n 3"]]:
        """World directions that light may come from, for uniform numbers, and what it is weighed by; see `ggx.sample`."""
        incoming, weight = ggx.sample(self.outgoing, u, self.base, self.gloss)
        return warp.to_world(incoming, self.frames), weight

    def density(self, directions: Float32[np.ndarray, "n 3"]) -> Float32[np.ndarray, " n"]:
        """Of what `scattered` gives, per steradian, at world directions."""
        return ggx.pdf(self.outgoing, _to_local(directions, self.frames), self.base, self.gloss)

    def part(self, which: slice | Int[np.ndarray, " some"]) -> "Lobes":
        """Some of them."""
        return Lobes(self.frames[which], self.outgoing[which], self.base[which], self.gloss[which])


@dataclass(frozen=True, eq=False)
class GlossyVertices:
    """Where paths met glossy surfaces, ready for any light.

    Attributes:
      there: places and receivers; the throughput is what a receiver gains for each W/(m² sr) that leaves towards the path's
        last vertex, over pi.
      lobes: the surfaces.
    """

    there: Vertices
    lobes: Lobes

    @classmethod
    def joined(cls, parts: "Sequence[GlossyVertices]") -> "GlossyVertices":
        """One list of many."""
        lobes = [part.lobes for part in parts]
        frames, outgoing = np.concatenate([part.frames for part in lobes]), np.concatenate([part.outgoing for part in lobes])
        base, gloss = np.concatenate([part.base for part in lobes]), np.concatenate([part.gloss for part in lobes])
        return cls(Vertices.joined([part.there for part in parts]), Lobes(frames, outgoing, base, gloss))

    @property
    def place(self) -> Float32[np.ndarray, "6 n"]:
        """Origins of shadow rays and normals, as in `Vertices`."""
        return self.there.place

    @property
    def owner(self) -> Int32[np.ndarray, " n"]:
        """The receivers."""
        return self.there.owner

    @property
    def facing(self) -> Float32[np.ndarray, "n 3"]:
        """The normals."""
        return self.there.facing

    def blocks(self) -> "Iterator[GlossyVertices]":
        """Parts of about equal size that fit into a core's cache."""
        first = 0
        for there in self.there.blocks():
            yield GlossyVertices(there, self.lobes.part(slice(first, first + len(there.owner))))
            first += len(there.owner)

    def under(self, light: Light, start: Float32[np.ndarray, "3"]) -> "GlossyVertices":
        """Where the light of one lamp is asked for: here, whichever it is."""
        return self

    def lit_from(self, directions: Float32[np.ndarray, "n 3"]) -> Vertices:
        """What each W/m² that arrives from directions is worth to the receivers."""
        lobes, there = self.lobes, self.there
        return replace(there, throughput=weighing.weigh(self._held, lobes.frames, lobes.outgoing, directions, there.throughput))

    @cached_property
    def _held(self) -> Float32[np.ndarray, "n 11"]:
        return weighing.prepared(self.lobes.outgoing, self.lobes.base, self.lobes.gloss)

    def go_on(self, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Origins and directions of the paths that survive roulette, their throughput and receivers."""
        u = rng.random((len(self.owner), 4), np.float32)
        directions, weight = self.lobes.scattered(u[:, :3])
        throughput = self.there.throughput * weight.T
        survival = np.minimum(np.float32(SURVIVAL) * throughput.max(0), np.float32(MAX_SURVIVAL))
        kept = np.flatnonzero(u[:, 3] < survival)
        origins = np.ascontiguousarray(self.place[:3, kept].T)
        return origins, directions[kept], throughput[:, kept] / survival[kept], self.owner[kept]


@dataclass(frozen=True, eq=False)
class Surfaces:
    """The glossy triangles of a scene.

    Attributes:
      tracer, scene: the geometry and its materials.
      shiny: which triangles.
      gloss: roughness, metallic and the dielectric's reflectance of each triangle, before textures.
    """

    tracer: Tracer
    scene: Scene
    shiny: Bool[np.ndarray, " triangles"]
    gloss: Float32[np.ndarray, "triangles 3"]

    @classmethod
    def of(cls, tracer: Tracer, scene: Scene) -> "Surfaces":
        """Those of a scene whose gloss is simulated."""
        parts = [material.gloss for material in scene.materials]
        rows = [(part.roughness, part.metallic, part.dielectric) if part else (1.0, 0.0, 0.0) for part in parts]
        return cls(tracer, scene, np.array(glossy(scene))[scene.material], np.array(rows, np.float32)[scene.material])

    def lobes(
        self,
        triangle: Int32[np.ndarray, " n"],
        u: Float32[np.ndarray, " n"],
        v: Float32[np.ndarray, " n"],
        directions: Float32[np.ndarray, "n 3"],
    ) -> Lobes:
        """Surfaces that rays of some directions hit, all of them glossy and from their front."""
        frames = self.tracer.frames[triangle]
        return Lobes(frames, _to_local(-directions, frames), *self.finish(triangle, u, v))

    def finish(
        self, triangle: Int32[np.ndarray, " n"], u: Float32[np.ndarray, " n"], v: Float32[np.ndarray, " n"]
    ) -> tuple[Float32[np.ndarray, "n 3"], Float32[np.ndarray, "n 3"]]:
        """Base colour and gloss at places of glossy triangles."""
        weights = np.stack([1 - u - v, u, v], 1)
        base, gloss = self.scene.albedo_at(triangle, weights).astype(np.float32), self.gloss[triangle]
        for index, material in enumerate(self.scene.materials):
            if material.gloss and material.gloss.texture is not None:
                chosen = self.scene.material[triangle] == index
                uv = self.scene.uv_at(triangle[chosen], weights[chosen])
                gloss[chosen, :2] *= bilinear(material.gloss.texture, uv)
        return base, gloss

    def met(
        self,
        triangle: Int32[np.ndarray, " n"],
        u: Float32[np.ndarray, " n"],
        v: Float32[np.ndarray, " n"],
        directions: Float32[np.ndarray, "n 3"],
        throughput: Float32[np.ndarray, "3 n"],
        owner: Int32[np.ndarray, " n"],
        _distance: Float32[np.ndarray, " n"] | None = None,  # of no use here; strands ask for it
    ) -> tuple[Int32[np.ndarray, " n"], GlossyVertices | None]:
        """Triangles that rays hit, -1 now where they are glossy, and the paths that met one of these from its front."""
        hit = np.flatnonzero(np.take(self.shiny, triangle, mode="wrap") & (triangle >= 0))
        if not len(hit):
            return triangle, None
        others = triangle.copy()
        others[hit] = -1
        normals = self.tracer.normals[triangle[hit]]
        hit = hit[np.einsum("nd,nd->n", normals, directions[hit]) < 0]
        if not len(hit):
            return others, None
        where = triangle[hit], u[hit], v[hit]
        normals = self.tracer.normals[where[0]]
        place = np.concatenate([lifted(self.tracer, self.tracer.on_triangle(*where), normals).T, normals.T])
        return others, GlossyVertices(
            Vertices(place, throughput[:, hit], owner[hit]), self.lobes(*where, np.ascontiguousarray(directions[hit]))
        )


def scattering(scene: Scene) -> Scene:
    """The scene whose albedo is what its surfaces scatter in all directions: of a glossy metal, nothing."""
    simulated = {id(material) for material, chosen in zip(scene.materials, glossy(scene), strict=True) if chosen}

    def diffuse(material: Material) -> Material:
        gloss = material.gloss
        if id(material) not in simulated or gloss is None or gloss.metallic == 0:
            return material
        if gloss.texture is None:
            red, green, blue = (channel * (1 - gloss.metallic) for channel in material.albedo)
            return replace(material, albedo=(red, green, blue))
        images = [gloss.texture, *([material.texture] if material.texture is not None else [])]
        height, width = np.max([image.shape[:2] for image in images], 0)
        row, column = np.divmod(np.arange(height * width), width)
        uv = np.stack([(column + 0.5) / width, (row + 0.5) / height], 1)
        scattered = 1 - gloss.metallic * bilinear(gloss.texture, uv)[:, 1:]
        colour = bilinear(material.texture, uv) if material.texture is not None else np.ones((1, 3))
        return replace(material, texture=(scattered * colour).reshape(height, width, 3))

    return scene.made_of(diffuse)


def _to_local(directions: Float32[np.ndarray, "n 3"], frames: Float32[np.ndarray, "n 3 3"]) -> Float32[np.ndarray, "n 3"]:
    return np.einsum("nij,nj->ni", frames, directions)
