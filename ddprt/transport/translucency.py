"""Which materials are filled with a medium, judged from the materials alone, and who cannot see them yet.

What simulates them is `ddprt.transport.subsurface`, which is imported where there is some.
"""

from dataclasses import replace

import numpy as np

from ddprt.axes import Bool
from ddprt.errors import UserError
from ddprt.scene.atlas import Atlas
from ddprt.scene.material import Material
from ddprt.scene.mesh import Scene


def filled(scene: Scene) -> tuple[bool, ...]:
    """Which of a scene's materials are in use and filled with a medium."""
    used = set(map(id, scene.used_materials))
    return tuple(entry.subsurface is not None and id(entry) in used for entry in scene.materials)


def exitant_texels(scene: Scene, atlas: Atlas) -> Bool[np.ndarray, " texels"]:
    """Which texels lie on such materials; pieces of a texel share its chart, and so its body."""
    found = np.zeros(atlas.count, bool)
    found[atlas.piece_texel] = np.array(filled(scene))[scene.material[atlas.piece_triangle]]
    return found


def opaque(material: Material) -> Material:
    """The material as a surface that scatters what a thick body of its medium would; itself where there is no medium."""
    if material.subsurface is None:
        return material
    red, green, blue = (own * thick for own, thick in zip(material.albedo, material.subsurface.thick_albedo, strict=True))
    return replace(material, albedo=(red, green, blue), subsurface=None)


def refuse_filled(scene: Scene, who: str) -> None:
    """Makes sure that nobody takes a body that light passes for an opaque one without being told.

    Raises:
      UserError: a material in use is filled with a medium.
    """
    names = [f'"{entry.name}"' for entry, chosen in zip(scene.materials, filled(scene), strict=True) if chosen]
    if names:
        raise UserError(
            f"{who}: got material {', '.join(names[:3])} with subsurface scattering, which the operator alone simulates, and "
            'not beside gloss or emission; expected opaque surfaces; set effects.off = ["subsurface"], or ddprt.force it off'
        )
