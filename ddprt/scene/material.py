"""What a surface does with light. Whatever is not plain diffuse reflection is a part of its own, and None where there is none.

So a scene says by itself which effects it calls for: one without a `Cutout` has no holes to look for.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from ddprt.axes import Float, Float32


@dataclass(frozen=True)
class Cutout:
    """Holes in a surface, as in leaves and fences: what is less opaque than the cutoff is not there.

    Attributes:
      opacity: (height, width), 0 to 1, row 0 at the top, looked up by the material's texture coordinates.
      cutoff: least opacity that stops light.
    """

    opacity: Float32[np.ndarray, "height width"] = field(repr=False, compare=False)
    cutoff: float = 0.5


@dataclass(frozen=True)
class Emission:
    """Light that a surface's front sends out by itself, the same in all directions and at all times.

    Attributes:
      radiance: linear Rec.709, W/(m² sr).
      texture: (height, width, 3) linear factor, row 0 at the top, or None.
    """

    radiance: tuple[float, float, float]
    texture: Float32[np.ndarray, "height width 3"] | None = field(default=None, repr=False, compare=False)


@dataclass(frozen=True)
class Gloss:
    """Reflection about the mirror direction: the metal-rough model of glTF 2.0 (GGX with Smith's shadowing, Schlick's Fresnel).

    The material's albedo is the base colour: a metal reflects it about the mirror direction and scatters nothing.

    Attributes:
      roughness: perceptual, 0 to 1; its square is the width of the lobe.
      metallic: 0 to 1.
      dielectric: reflectance at normal incidence of what is not metal.
      texture: (height, width, 2) factors on roughness and metallic, row 0 at the top, or None.
    """

    roughness: float = 1.0
    metallic: float = 0.0
    dielectric: float = 0.04
    texture: Float32[np.ndarray, "height width 2"] | None = field(default=None, repr=False, compare=False)


@dataclass(frozen=True)
class Subsurface:
    """A homogeneous medium that fills a closed body: light enters, scatters about inside, and leaves elsewhere.

    The material's albedo then multiplies what leaves, like a stain on the surface; it does not tint what enters.

    Attributes:
      albedo: of single scattering, 0 to 1 per channel: the share that is not swallowed where light meets matter.
      mean_free_path: between two such meetings, metres per channel.
      anisotropy: mean cosine of the angle of scattering (Henyey and Greenstein 1941), -1 to 1, both excluded.
      index: of refraction, relative to the outside, 1 to 4; 1 lets light pass the surface unbent.
    """

    albedo: tuple[float, float, float]
    mean_free_path: tuple[float, float, float]
    anisotropy: float = 0.0
    index: float = 1.0

    @staticmethod
    def single_albedo(thick: float, anisotropy: float) -> float:
        """The albedo of single scattering of an unbounded medium that sends back so much (`thick_albedo`, index 1)."""
        b = 1.139 + 1.17 * thick
        similar = (b - (b * b - 0.556 * (1 - thick)) ** 0.5) / 0.278
        return min(max((1 - similar**2) / (1 - anisotropy * similar**2), 0.0), 1.0)

    @property
    def thick_albedo(self) -> tuple[float, float, float]:
        """What a thick body sends back of light from everywhere, as an opaque surface would: within 0.01 of exact.

        Reference: van de Hulst, "Multiple Light Scattering", 1980, 11.3. Behind a refractive surface light goes round by the
        boundary's mean reflectances: the inner by Egan and Hilgeman, "Optical Properties of Inhomogeneous Materials", 1979,
        the outer by reciprocity.
        """
        index = self.index
        inner = 0.0 if index == 1 else -1.4399 / index**2 + 0.7099 / index + 0.6681 + 0.0636 * index
        entering = (1 - inner) * index**2
        found = []
        for albedo in self.albedo:
            similar = ((1 - albedo) / (1 - self.anisotropy * albedo)) ** 0.5 if albedo < 1 else 0.0
            bare = (1 - similar) * (1 - 0.139 * similar) / (1 + 1.17 * similar)
            found.append(entering * bare * (1 - inner) / (1 - inner * bare))
        red, green, blue = found
        return red, green, blue


@dataclass(frozen=True)
class Fibre:
    """What a strand of hair does with light: the model of Chiang et al., 2016; see `ddprt.transport.fibre`.

    The material's albedo is the colour of much hair seen from afar, where a strand has none of its own.

    Attributes:
      along: roughness along the fibre, 0 to 1, 0 excluded.
      around: roughness about it, likewise.
      tilt_deg: of the scales on its surface, towards the root.
      index: of refraction, above 1.
      absorption: optical depth of a radius per channel; None takes what gives the strand its colour.
    """

    along: float = 0.3
    around: float = 0.3
    tilt_deg: float = 2.0
    index: float = 1.55
    absorption: tuple[float, float, float] | None = None


@dataclass(frozen=True)
class Material:
    """A surface. Textures of one material share its texture coordinates.

    Attributes:
      name: for messages.
      albedo: linear Rec.709 reflectance, each 0 to 1.
      texture: (height, width, 3) linear factor on the albedo, row 0 at the top, or None.
      two_sided: the back reflects as the front does; `checked` makes surfaces of their own of such backs.
      cutout, emission, gloss, subsurface, fibre: what there is besides; only strands may be of a material with a fibre.
    """

    name: str
    albedo: tuple[float, float, float]
    texture: np.ndarray | None = field(default=None, repr=False, compare=False)
    two_sided: bool = False
    cutout: Cutout | None = field(default=None, repr=False)
    emission: Emission | None = field(default=None, repr=False)
    gloss: Gloss | None = field(default=None, repr=False)
    subsurface: Subsurface | None = field(default=None, repr=False)
    fibre: Fibre | None = field(default=None, repr=False)

    @cached_property
    def brightest(self) -> float:
        """Largest reflectance of a channel anywhere on it."""
        base = np.array(self.albedo)
        return float((base if self.texture is None else base * self.texture.max((0, 1))).max())

    @property
    def textures(self) -> dict[str, np.ndarray]:
        """All images, by what they change."""
        parts = (("emission", self.emission), ("gloss", self.gloss))
        found = {"albedo": self.texture, **{name: part.texture for name, part in parts if part}}
        found |= {"opacity": self.cutout.opacity} if self.cutout else {}
        return {name: image for name, image in found.items() if image is not None}

    def retextured(self, images: Mapping[str, np.ndarray]) -> "Material":
        """The same with other images, by the names of `textures`."""
        lit = {"emission": self.emission, "gloss": self.gloss}
        changed: dict[str, Any] = {
            name: replace(part, texture=images[name]) for name, part in lit.items() if part and name in images
        }
        if self.cutout:
            changed["cutout"] = replace(self.cutout, opacity=images["opacity"])
        return replace(self, texture=images.get("albedo"), **changed)


def bilinear(image: Float[np.ndarray, "height width ..."], uv: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n ..."]:
    """Repeating bilinear lookup, texel centres at half-integers."""
    height, width = image.shape[:2]
    position = uv * [width, height] - 0.5
    corner = np.floor(position).astype(int)
    fx, fy = (position - corner).T.reshape(2, -1, *(1,) * (image.ndim - 2))
    x0, y0 = corner[:, 0] % width, corner[:, 1] % height
    x1, y1 = (x0 + 1) % width, (y0 + 1) % height
    top = image[y0, x0] * (1 - fx) + image[y0, x1] * fx
    bottom = image[y1, x0] * (1 - fx) + image[y1, x1] * fx
    return top * (1 - fy) + bottom * fy


def plain(material: Material) -> Material:
    """The same surface with its one albedo alone."""
    return Material(material.name, material.albedo)
