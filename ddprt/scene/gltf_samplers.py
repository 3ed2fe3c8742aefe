"""How the textures of a glTF material go on beyond their rims."""

from typing import Any

from ddprt.scene.accessors import Container
from ddprt.scene.wrapping import CLAMP, MIRROR, REPEAT


def wraps(file: Container, material: Any) -> dict[str, tuple[int, int]]:
    """Modes of those images of a material that do not repeat both ways, across and down, by the names of `Material.textures`.

    Raises:
      UserError: a mode that glTF does not know.
    """
    base, found = material.pbrMetallicRoughness, {}
    owners = {
        "albedo": base and base.baseColorTexture,
        "opacity": base and base.baseColorTexture,
        "emission": material.emissiveTexture,
        "gloss": base and base.metallicRoughnessTexture,
    }
    for name, owner in owners.items():
        number = None if owner is None else file.entry("textures", owner.index).sampler
        if number is None:
            continue
        sampler = file.entry("samplers", number)
        across, down = (REPEAT if mode is None else mode for mode in (sampler.wrapS, sampler.wrapT))
        for mode in (across, down):
            if mode not in (REPEAT, CLAMP, MIRROR):
                raise file.fault(
                    f"got wrap mode {mode} in sampler {number}, expected {REPEAT}, {CLAMP} or {MIRROR}; export it again"
                )
        if (across, down) != (REPEAT, REPEAT):
            found[name] = (across, down)
    return found
