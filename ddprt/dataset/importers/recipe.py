"""What an import is told: options of the command line or a TOML file, and what a folder's own names tell."""

import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

from pydantic import Field, ValidationError

from ddprt.dataset.importers.colour import SPACES
from ddprt.dataset.importers.quantities import QUANTITIES
from ddprt.errors import UserError, explain, nearest
from ddprt.sections import Section

FILE = "import.toml"
_PICTURES = (".exr", ".hdr", ".png", ".tif", ".tiff", ".jpg", ".jpeg")
_MAPS = ("albedo", "mask", "position", "normal", "area")


class Recipe(Section):
    """Where the light is, and what it is; paths count from the folder that is imported."""

    name: str = Field("", description="of the scene, in reports; the folder's own by default")
    indirect: str = Field("", description="pictures to learn, one star for the name of the lighting: 'indirect/*.exr'")
    direct: str = Field("", description="pictures of direct light, likewise")
    measured: str = Field("", description="FILE  measured values, .npy, .npz or .csv, (lightings, points, 3), in place of maps")
    lights: str = Field("", description="FILE  lights, .csv or .json; or an .lp file and its photographs")
    channels: str = Field("", description="layer (wildcards allowed) or three channels with commas; of both kinds")
    direct_channels: str = Field("", description="of direct light alone")
    indirect_channels: str = Field("", description="of indirect light alone")
    colour: str = Field("auto", description=f"auto, {', '.join(SPACES)}")
    quantity: str = Field("auto", description=f"auto, {', '.join(QUANTITIES)}")
    albedo: str = Field("", description="FILE  albedo of every texel")
    mask: str = Field("", description="FILE  texels that count, above 0; alpha or what is lit by default")
    position: str = Field("", description="FILE  world positions, metres; needs a normal")
    normal: str = Field("", description="FILE  world normals")
    area: str = Field("", description="FILE  m² of every texel; from positions, or all alike, by default")
    geometry: str = Field("", description="FILE  .glb, .gltf or .obj with lightmap coordinates (TEXCOORD_1), metres, Y up")
    points: str = Field("128", description="how many texels of the direct maps to measure, or a points.json")
    measure: Literal["auto", "texels", "ball"] = Field(
        "auto", description="auto, texels, or ball: a white ball under the lights"
    )
    test: float = Field(0.2, gt=0, lt=1, description="share of lightings that are held out")
    validation: float = Field(0.1, gt=0, lt=1, description="share that learned methods stop on")
    seed: int = Field(0, ge=0, le=2**32 - 1, description="of the split and the points")
    clip: bool = Field(False, description="cut negative light off instead of refusing it")

    def to_toml(self) -> str:
        """The recipe as TOML, accepted as input again."""
        import json

        return "".join(f"{key} = {json.dumps(value)}\n" for key, value in self.model_dump().items())


def load_recipe(source: Path, options: Mapping[str, str]) -> tuple[Recipe, Path, list[str]]:
    """The recipe of a folder (or of a TOML file in it), its folder, and what was found there without being named.

    Options go before the file, the file before what lies in the folder.

    Raises:
      UserError: no such folder, an unknown key or a value out of range.
    """
    folder = source if source.is_dir() else source.parent
    file = folder / FILE if source.is_dir() else source
    if not folder.is_dir() or not (source.is_dir() or file.is_file()):
        raise UserError(f"{source}: got no such folder, expected one with pictures, or a TOML recipe; check the path")
    document: dict[str, Any] = {}
    if file.is_file():
        try:
            document = tomllib.loads(file.read_text("utf-8"))
        except (OSError, tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
            raise UserError(f"{file}: got text that is not TOML ({error}), expected key = value; mend it") from None
    document |= {key.replace("-", "_"): value for key, value in options.items()}
    for key in document:
        if key not in Recipe.model_fields:
            known = list(Recipe.model_fields)
            raise UserError(f"{file}: unknown key {key}{nearest(key, known)}; known here: {', '.join(known)}")
    found = {key: value for key, value in _lying(folder, document).items() if key not in document}
    # What merely lies there gives way to a mesh that was asked for.
    idle = [found.pop(key) for key in ("position", "normal") if key in found and document.get("geometry")]
    try:
        recipe = Recipe.model_validate({**found, **{key: _value(value) for key, value in document.items()}})
    except ValidationError as error:
        fault = error.errors()[0]
        raise UserError(f"--{str(fault['loc'][0]).replace('_', '-')}: {explain([fault])}") from None
    if recipe.quantity != "auto":
        QUANTITIES[recipe.quantity]
    if recipe.colour != "auto":
        SPACES[recipe.colour]
    if recipe.test + recipe.validation >= 1:
        raise UserError(f"--test: got {recipe.test:g} and {recipe.validation:g}, expected a sum below 1; lower one")
    told = [f"{', '.join(idle)}: left aside for the mesh of --geometry"] if idle else []
    return recipe, folder, [*(f"{key}: {value}" for key, value in found.items()), *told]


def _value(text: Any) -> Any:
    return str(text) if isinstance(text, int) and not isinstance(text, bool) else text


def _lying(folder: Path, given: Mapping[str, Any]) -> dict[str, str]:
    """Files of the usual names in a folder.

    Raises:
      UserError: several that could be meant, and no option says which.
    """
    names = {path.name for path in folder.iterdir()}
    found = {}
    lights = [name for name in sorted(names) if name in ("lights.csv", "lights.json") or name.endswith(".lp")]
    if len(lights) > 1 and "lights" not in given:
        raise UserError(f"{folder}: got {' and '.join(lights)}, expected one list of lights; name it with --lights")
    if len(lights) == 1:
        found["lights"] = lights[0]
    photographs = str(given.get("lights", found.get("lights", ""))).endswith(".lp")
    for kind in () if photographs else ("direct", "indirect"):
        inside = sorted((folder / kind).iterdir()) if (folder / kind).is_dir() else []
        suffixes = sorted({path.suffix for path in inside if path.suffix.lower() in _PICTURES})
        if len(suffixes) > 1 and kind not in given:
            raise UserError(
                f"{folder / kind}: got pictures that end in {' and '.join(suffixes)}, expected one kind; take the others away, "
                f"or name them with --{kind} '{kind}/*{suffixes[0]}'"
            )
        if len(suffixes) == 1:
            found[kind] = f"{kind}/*{suffixes[0]}"
    for key in _MAPS:
        there = [f"{key}{suffix}" for suffix in _PICTURES if f"{key}{suffix}" in names]
        if there:
            found[key] = there[0]
    for key, fitting in (("measured", ("measured.npy", "measured.npz", "measured.csv")), ("points", ("points.json",))):
        there = [name for name in fitting if name in names]
        if there:
            found[key] = there[0]
    return found
