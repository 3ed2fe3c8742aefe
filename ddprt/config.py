"""Every setting of a run: one frozen model per section, in the order of the walk.

TOML goes in, the resolved configuration comes out and is accepted as input again. `--section.key value` on the command
line overrides the file. This module imports no room, so that `ddprt --help` stays instant.
"""

import hashlib
import json
import tomllib
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator, model_validator

from ddprt.errors import UserError, nearest, spoken
from ddprt.errors import explain as explained

Range = tuple[float, float]
Unit = Annotated[float, Field(ge=0.0, le=1.0)]


class Section(BaseModel):
    """A section of the file: unknown keys are errors, values never change."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    @field_validator("*", mode="before")
    @classmethod
    def _truth_is_no_number(cls, value: Any) -> Any:
        """`true` would pass for 1: it is taken for the word, which a truth value accepts and a number does not."""
        if isinstance(value, list):
            return [str(entry).lower() if isinstance(entry, bool) else entry for entry in value]
        return str(value).lower() if isinstance(value, bool) else value


class SceneConfig(Section):
    """What stays still."""

    name: str = Field("cornell", description="a name of SCENES, or a path to an .obj, .ply, .stl, .gltf or .glb file")
    parameters: dict[str, float] = Field({}, description="numbers that a scene in code takes, e.g. {albedo = 0.5}")


class AtlasConfig(Section):
    """The lightmap that the scene is unwrapped onto."""

    resolution: int = Field(256, ge=8, le=8192, description="texels per side, met exactly")
    padding: int = Field(2, ge=1, le=64, description="empty texels between charts")


class LightingsConfig(Section):
    """The lightings that are baked: drawn from a distribution, or read from a file."""

    train: int = Field(128, ge=1, description="lightings to learn from")
    validation: int = Field(16, ge=1, description="lightings that learned methods stop early on")
    test: int = Field(32, ge=1, description="held-out lightings that every score is computed on")
    file: str = Field("", description="JSON list of lightings to use; split in the order train, validation, test")
    distribution: Literal["room", "around"] = Field(
        "room", description="room: free space inside the bounding box; around: a shell about the asset"
    )
    kinds: tuple[Literal["point", "spot", "directional", "rect", "sphere"], ...] = Field(
        ("point",), min_length=1, description="kinds of light to draw from, each equally likely"
    )
    lights: tuple[int, int] = Field((1, 1), description="fewest and most lights that are on together")
    region_low: tuple[Unit, Unit, Unit] = Field(
        (0.0, 0.0, 0.0), description="room: lowest lamp position as fractions of the bounding box (x, y, z)"
    )
    region_high: tuple[Unit, Unit, Unit] = Field((1.0, 1.0, 1.0), description="room: highest lamp position, likewise")
    clearance: float = Field(
        0.05, ge=0.0, description="room: metres to keep from every surface, whatever the size of the scene"
    )
    distance: Range = Field((1.5, 3.0), description="around: distance from the asset's centre in bounding radii")
    elevation_deg: Range = Field((0.0, 90.0), description="around: height above the horizon")
    intensity: tuple[Annotated[float, Field(gt=0, le=1e25)], Annotated[float, Field(gt=0, le=1e25)]] = Field(
        (1.0, 1.0), description="W/sr of a lamp at each end of a log-uniform range"
    )
    saturation: Range = Field((0.0, 0.0), description="0 is white, 1 a fully saturated random hue")
    spot_outer_deg: Range = Field((25.0, 50.0), description="half-angle of a spot's cone; the inner cone is 0.6 of it")
    size: float = Field(0.05, gt=0.0, description="area lights: half-edge or radius, as a fraction of the bounding radius")

    @model_validator(mode="after")
    def _ranges_rise(self) -> "LightingsConfig":
        for name in ("lights", "distance", "elevation_deg", "intensity", "saturation", "spot_outer_deg"):
            low, high = getattr(self, name)
            if low > high:
                raise ValueError(f"{name}: got [{low:g}, {high:g}], expected the lower end first; swap them")
        if self.lights[0] < 1:
            raise ValueError(f"lights: got {self.lights[0]} as the fewest, expected at least 1; raise it")
        low, high = self.saturation
        if not 0 <= low <= high <= 1:
            raise ValueError(f"saturation: got [{low:g}, {high:g}], expected both ends between 0 and 1; move them there")
        low, high = self.spot_outer_deg
        if not 0 < low <= high < 90:
            raise ValueError(
                f"spot_outer_deg: got [{low:g}, {high:g}], expected half-angles above 0 and below 90; move them there"
            )
        for axis, low, high in zip("xyz", self.region_low, self.region_high, strict=True):
            if low >= high:
                raise ValueError(
                    f"region_low: got {low:g} for {axis}, expected less than {high:g} of region_high; lower it or raise that"
                )
        return self


class PointsConfig(Section):
    """Where direct light is measured."""

    count: int = Field(128, ge=1, description="measurement points")
    supersample: int = Field(8, ge=1, le=64, description="samples averaged into each point")
    on: Literal["surface", "hull"] = Field(
        "surface", description="the scene's surface, or its convex hull (for assets seen from outside)"
    )
    depth: Literal["auto"] | Annotated[float, Field(ge=0, le=8)] = Field(
        "auto",
        description="how far behind its surface a sample is lit, in distances between samples, to even out what lamps nearer "
        "than that do; auto: 0.75 where there are such lamps, else 0",
    )
    file: str = Field("", description="JSON list of {position, normal, albedo} to use instead of distributing points")
    quantity: Literal["radiosity", "irradiance"] = Field("radiosity", description="what is measured there, W/m²")


class TransportConfig(Section):
    """How light is simulated."""

    integrator: Literal["auto", "operator", "paths", "reference"] = Field(
        "auto",
        description="auto: the operator; paths: unbiased, shared by all lightings; reference: each lighting alone",
    )
    samples: Literal["auto"] | Annotated[int, Field(ge=1, le=65536)] = Field(
        "auto", description="mean gather rays per texel for train and validation; auto: as target_noise asks"
    )
    test_samples: Literal["auto"] | Annotated[int, Field(ge=2, le=131072)] = Field(
        "auto", description="gather rays per texel for held-out lightings, in two halves; auto: as target_noise asks"
    )
    target_noise: float = Field(0.01, ge=1e-4, le=1.0, description="relative RMSE of the maps that auto samples aim at")
    footprint: Unit = Field(
        0.05,
        description="train and validation: texels share rays within this share of the harmonic mean distance to what they see; "
        "0: never",
    )
    denoise: bool = Field(False, description="train and validation: filter maps by Open Image Denoise (extra denoise)")
    adaptive: bool = Field(True, description="train and validation: more rays where footprints are small and light varies")
    direct_samples: int = Field(4, ge=1, le=1024, description="shadow rays per texel and light; more near lamps")
    sender_resolution: int = Field(
        0,
        ge=0,
        le=1024,
        description="texels per side of the coarser atlas that light bounces off; 0: at most 128",
    )
    bounces: int = Field(-1, ge=-1, description="-1: as many as the scene calls for; 0, 1, 2...: forced, and reported")
    threads: int = Field(0, ge=0, description="0: one per core")


class FitConfig(Section):
    """From pairs to a runtime."""

    method: str = Field("svd-ridge", description="entry of METHODS that is saved and exported")
    points: int = Field(0, ge=0, description="measurement points to use; 0: all that were baked")
    bases: int = Field(16, ge=1, description="basis vectors, the mean counted in where there is one")
    space: Literal["linear", "gamma"] = Field("linear", description="where transfer happens")
    gamma: float = Field(2.2, ge=1.0, le=10.0, description="exponent of the gamma space")
    centre: Literal["none", "mean"] = Field("none", description="none keeps relighting exactly linear; mean is the paper's")
    channels: Literal["mono", "multi"] = Field("mono", description="one basis and a matrix per channel, or interleaved colours")
    weights: Literal["area", "texel"] = Field("area", description="what the basis is best for: the surface, or the atlas")
    ridge: Literal["auto"] | Annotated[float, Field(ge=0.0)] | tuple[Annotated[float, Field(ge=0.0)], ...] = Field(
        "auto", description="auto (leave-one-out), a number, or one number per measurement point; 0 is the pseudo-inverse"
    )


class MethodsConfig(Section):
    """Who is compared on the same split."""

    compare: tuple[str, ...] = Field(("svd-ridge", "mean", "nearest", "mlp"), description="entries of METHODS in the table")
    settings: dict[str, dict[str, Any]] = Field({}, description="a method's own settings, e.g. [methods.settings.mlp]")


class ReportConfig(Section):
    """What the report shows."""

    rows: int = Field(4, ge=1, le=64, description="held-out lightings shown as pictures")
    bases_curve: tuple[Annotated[int, Field(ge=1)], ...] = Field(
        (4, 8, 16, 32, 64), min_length=1, description="numbers of bases on the error curve"
    )
    spot_check_texels: int = Field(256, ge=0, description="texels checked against the reference integrator; 0 skips")
    spot_check_lightings: int = Field(4, ge=1, description="held-out lightings checked there")
    spot_check_samples: int = Field(512, ge=2, description="paths per texel of that check")


class ExportConfig(Section):
    """What engines load."""

    precision: Literal["half", "float"] = Field("half", description="of the basis textures")
    gutter: int = Field(4, ge=0, le=64, description="texels that charts are extended by, smoothly")
    stitch: bool = Field(True, description="make charts agree where a smooth surface was cut to be unwrapped")


class Config(Section):
    """A whole run."""

    seed: int = Field(0, ge=0, le=2**32 - 1, description="every random number follows from it")
    scene: SceneConfig = SceneConfig()
    atlas: AtlasConfig = AtlasConfig()
    lightings: LightingsConfig = LightingsConfig()
    points: PointsConfig = PointsConfig()
    transport: TransportConfig = TransportConfig()
    fit: FitConfig = FitConfig()
    methods: MethodsConfig = MethodsConfig()
    report: ReportConfig = ReportConfig()
    export: ExportConfig = ExportConfig()

    def to_toml(self) -> str:
        """The resolved configuration as TOML, accepted as input again."""
        document = self.model_dump(mode="json")
        lines = [f"seed = {document.pop('seed')}"]
        for section, values in document.items():
            lines += ["", f"[{section}]", *(f"{key} = {_toml(value)}" for key, value in values.items())]
        return "\n".join(lines) + "\n"

    def digest(self, *sections: str) -> str:
        """Hash of the named sections (all, if none are named) and the seed: equal digests mean equal results."""
        chosen = self.model_dump(mode="json", include={*sections, "seed"} if sections else None)
        return hashlib.sha256(json.dumps(chosen, sort_keys=True).encode()).hexdigest()[:16]


def load_config(path: str | Path | None, overrides: dict[str, str] | None = None) -> Config:
    """Reads a TOML file (or the defaults) and applies overrides.

    Args:
      path: the file, or None for the defaults.
      overrides: dotted key to the text given on the command line, e.g. `{"fit.bases": "32"}`.
    Returns:
      The validated configuration. Relative paths in it are taken from the working directory.
    Raises:
      UserError: one line with file, key, got, expected and what to do for the first fault.
    """
    document: dict[str, Any] = {}
    if path is not None:
        try:
            document = tomllib.loads(Path(path).read_text("utf-8"))
        except OSError as error:
            raise UserError(f"{path}: got {error.strerror or error}, expected a readable TOML file; check the path") from None
        except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
            raise UserError(
                f"{path}: got text that is not TOML ({error}), expected [section] and key = value; mend it"
            ) from None
    overrides = {_as_written(dotted): text for dotted, text in (overrides or {}).items()}
    for dotted, text in overrides.items():
        check_key(dotted)
        *parents, leaf = dotted.split(".")
        table = document
        for parent in parents:
            table = table.setdefault(parent, {})
            if not isinstance(table, dict):
                raise UserError(f"--{dotted}: got a table, but {path} gives {parent} a plain value; mend the file")
        table[leaf] = _literal(text)
    return checked(document, path, overrides)


def checked(document: dict[str, Any], path: str | Path | None = None, overrides: dict[str, str] | None = None) -> Config:
    """A nested dictionary as a configuration; `path` and `overrides` are where it came from.

    Raises:
      UserError: see `load_config`.
    """
    try:
        return Config.model_validate(document)
    except ValidationError as error:
        raise UserError(explain(error, path, overrides or {})) from None


def keys(model: type[BaseModel] = Config, prefix: str = "") -> list[str]:
    """Every dotted key, e.g. "fit.bases"."""
    found = []
    for name, field in model.model_fields.items():
        annotation = field.annotation
        if isinstance(annotation, type) and issubclass(annotation, Section):
            found += keys(annotation, f"{prefix}{name}.")
        else:
            found.append(prefix + name)
    return found


def explain(error: ValidationError, path: str | Path | None, overrides: dict[str, str]) -> str:
    """First fault of a pydantic error as one line: file, key, got, expected, what to do."""
    faults = error.errors()
    fault = faults[0]
    key, text = spoken(fault)
    place = [str(part) for part in (*fault["loc"], key) if part != ""]
    dotted = next((key for n in range(len(place), 0, -1) if (key := ".".join(place[:n])) in keys()), ".".join(place))
    source = f"--{dotted}" if dotted in overrides else f"{path or 'configuration'}: {dotted}"
    if fault["type"] == "extra_forbidden":
        siblings = [key for key in keys() if key.split(".")[:-1] == place[:-1]] or keys()
        sections = [*siblings, *(key.split(".")[0] for key in keys())] if len(place) == 1 else siblings
        names = sorted({key.rsplit(".", 1)[-1] for key in sections})
        return f"{source}: unknown key{nearest(place[-1], names)}; known here: {', '.join(names)}"
    if text:
        return f"{source}: {text}"
    # A list whose entries are faulty counts as short of them, too.
    related = [
        other
        for other in faults
        if ".".join(map(str, other["loc"])).startswith(dotted) and (other is fault or other["type"] != "too_short")
    ]
    default: Any = Config()
    for part in dotted.split("."):
        default = getattr(default, part, None)
    shown = "" if default is None or isinstance(default, Section | dict) else f", {_toml(default)}"
    return f"{source}: {explained(related, default, f'mend it, or leave it out for the default{shown}')}"


def _as_written(dotted: str) -> str:
    """The key as the file spells it: the help prints hyphens, as command lines do."""
    plain = dotted.replace("-", "_")
    return plain if plain in keys() else dotted


def check_key(dotted: str, verb: str = "run") -> None:
    """Makes sure that `--dotted` is a setting.

    Raises:
      UserError: it is not; `verb` is the one whose help is named.
    """
    known, free = keys(), ("scene.parameters.", "methods.settings.")
    if _as_written(dotted) not in known and not dotted.startswith(free):
        raise UserError(f"--{dotted}: unknown key{nearest(dotted, known)}; `ddprt {verb} --help` lists all")


def _literal(text: str) -> Any:
    """A TOML value if the text is one, else the text itself: `0.1`, `[1, 2]` and `auto` all work."""
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        return text


def _toml(value: Any) -> str:
    if isinstance(value, dict):
        return "{" + ", ".join(f"{json.dumps(key)} = {_toml(item)}" for key, item in value.items()) + "}"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(map(_toml, value)) + "]"
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")  # TOML allows no raw DEL
    return json.dumps(value)
