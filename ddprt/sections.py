"""The sections of a configuration: one frozen pydantic model each, in the order of the walk."""

from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, field_validator, model_validator

Range = tuple[float, float]
Unit = Annotated[float, Field(ge=0.0, le=1.0)]
Count = Annotated[int, Field(ge=0, le=1024)]


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


class FogConfig(Section):
    """A homogeneous medium that fills the scene's bounding box; see `ddprt.scene.fog`."""

    mean_free_path: tuple[float, ...] = Field((), description="metres per channel, or one number for all; none: no fog")
    albedo: tuple[float, ...] = Field((1.0,), description="of single scattering, 0 to 1, likewise")
    anisotropy: float = Field(0.0, description="mean cosine of the angle of scattering, -1 to 1, both excluded")

    @field_validator("mean_free_path", "albedo", mode="before")
    @classmethod
    def _of_all_channels(cls, value: Any) -> Any:
        if isinstance(value, int | float) and not isinstance(value, bool):
            return [value]
        if not isinstance(value, list | tuple):
            raise ValueError(f"got {value!r}, expected a number, or one for each of red, green and blue; mend it")
        return value

    @model_validator(mode="after")
    def _is_whole(self) -> "FogConfig":
        if not self.mean_free_path and self != FogConfig.model_construct():
            raise ValueError("mean_free_path: got none, expected metres, e.g. [0.5]; add it, or leave [scene.fog] out")
        return self

    @property
    def given(self) -> dict[str, Any] | None:
        """What `load_scene` takes; None for clear air."""
        return self.model_dump() if self.mean_free_path else None


class SceneConfig(Section):
    """What stays still."""

    name: str = Field("cornell", description="a name of SCENES, or a path to an .obj, .ply, .stl, .gltf or .glb file")
    parameters: dict[str, float] = Field({}, description="numbers that a scene in code takes, e.g. {albedo = 0.5}")
    fog: FogConfig = FogConfig()
    poses: tuple[str, ...] = Field((), description="mesh files of one topology, keyframes of an animation, in place of name")


class AnimationConfig(Section):
    """Keyframes of what moves: none unless they are asked for here, or by scene.poses."""

    keys: Annotated[int, Field(ge=0, le=256)] | Annotated[tuple[float, ...], Field(min_length=1)] = Field(
        0, description="how many, evenly over the motion, or their times in seconds; 0: the scene stands still"
    )
    between: tuple[float, ...] = Field(
        (0.5,), description="shares of the way from key to key at which poses are tested that nobody learned from"
    )
    matrices: Literal["one", "each", "both"] = Field(
        "both", description="transfer matrices: one for all keys, one for each, or both compared and those of each kept"
    )
    clip: str = Field("", description="name or number of the animation in a glTF file; empty: the first")

    @field_validator("between")
    @classmethod
    def _on_the_way(cls, shares: tuple[float, ...]) -> tuple[float, ...]:
        if wrong := [share for share in shares if not 0 < share < 1]:
            raise ValueError(
                f"got {wrong[0]:g}, expected shares above 0 and below 1; leave it out, keyframes are tested anyway"
            )
        if len(set(shares)) < len(shares):
            raise ValueError(f"got {list(shares)}, expected each share once; leave out what is there twice")
        return shares

    @field_validator("clip", mode="before")
    @classmethod
    def _by_number(cls, name: Any) -> Any:
        return str(name) if isinstance(name, int) and not isinstance(name, bool) else name


class AtlasConfig(Section):
    """The lightmap that the scene is unwrapped onto."""

    resolution: int = Field(256, ge=8, le=8192, description="texels per side, met exactly")
    padding: int = Field(2, ge=1, le=64, description="empty texels between charts")
    use: Literal["auto", "own", "new"] = Field(
        "auto", description="own: the file's second texture coordinates; new: xatlas; auto: own where there are sound ones"
    )


class LightingsConfig(Section):
    """The lightings that are baked: drawn from a distribution, or read from a file."""

    train: int = Field(128, ge=1, description="lightings to learn from")
    validation: int = Field(16, ge=1, description="lightings that learned methods stop early on")
    test: int = Field(32, ge=1, description="held-out lightings that every score is computed on")
    file: str = Field(
        "", description="JSON list of lightings, or glTF whose lights are one each; split in the order train, validation, test"
    )
    gltf_units: Literal["photometric", "radiometric"] = Field(
        "photometric", description="of lights in glTF: candela and lux, 683 lm a watt; or W/sr and W/m² as they stand"
    )
    choose: Literal["random", "active"] = Field(
        "random", description="train: as drawn; or those of many candidates whose measurements are least like the others'"
    )
    candidates: int = Field(8, ge=1, le=64, description="active: candidates drawn for each lighting that is baked")
    target_error: float = Field(
        0.0,
        ge=0.0,
        description="active: relative RMSE on validation at which no more are baked; 0: bake all of train",
    )
    distribution: Literal["room", "around"] = Field(
        "room", description="room: free space inside the bounding box; around: a shell about the asset"
    )
    kinds: tuple[Literal["point", "spot", "directional", "rect", "sphere", "environment"], ...] = Field(
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
        (1.0, 1.0), description="W/sr of a lamp at each end of a log-uniform range; W/m² of a directional light; scale of a sky"
    )
    saturation: Range = Field((0.0, 0.0), description="0 is white, 1 a fully saturated random hue")
    spot_outer_deg: Range = Field((25.0, 50.0), description="half-angle of a spot's cone; the inner cone is 0.6 of it")
    size: float = Field(0.05, gt=0.0, description="area lights: half-edge or radius, as a fraction of the bounding radius")
    environment: str = Field(
        "sun-sky", min_length=1, description="image of environment lights: an .exr or .hdr file, or white, gradient or sun-sky"
    )

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
    choose: Literal["blue-noise", "qr"] = Field(
        "blue-noise", description="which samples become points: evenly spread, or by pivoted QR of what training lights there"
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


class EffectsConfig(Section):
    """What is simulated against the scene's own judgement; `ddprt inspect` lists the names."""

    on: tuple[str, ...] = Field((), description="effects to simulate though the scene does not call for them")
    off: tuple[str, ...] = Field((), description="effects to leave out though the scene calls for them")
    glossy_layers: bool = Field(
        True, description="keep what the eye sees on glossy texels, beside the lightmap that they light"
    )


class ProbesConfig(Section):
    """Points in free air whose light objects take that move through the scene; none unless a grid or a file names some."""

    grid: tuple[Count, Count, Count] = Field((0, 0, 0), description="probes along x, y and z; 0, 0, 0: none")
    region_low: tuple[Unit, Unit, Unit] = Field(
        (0.0, 0.0, 0.0),
        description="lowest corner of the grid as fractions of the bounding box; each probe in its cell's middle",
    )
    region_high: tuple[Unit, Unit, Unit] = Field((1.0, 1.0, 1.0), description="highest corner, likewise")
    file: str = Field("", description="JSON list of positions [x, y, z] in metres, in place of a grid")
    rays: Literal["auto"] | Annotated[int, Field(ge=16, le=2**20)] = Field(
        "auto",
        description="rays of each probe (of each half, for held-out lightings), rounded up to a power of two; auto: as "
        "transport.target_noise asks",
    )

    @model_validator(mode="after")
    def _one_way(self) -> "ProbesConfig":
        if any(self.grid) and not all(self.grid):
            raise ValueError(f"grid: got {list(self.grid)}, expected at least 1 along each axis, or [0, 0, 0]; raise the zeros")
        if any(self.grid) and self.file:
            raise ValueError("file: got one together with a grid, expected one of the two; leave one out")
        if any(low >= high for low, high in zip(self.region_low, self.region_high, strict=True)):
            raise ValueError("region_low: got no less than region_high, expected a box; lower it or raise that")
        return self

    @property
    def asked(self) -> str:
        """Which probes, in words; empty for none."""
        return self.file or (" x ".join(map(str, self.grid)) if any(self.grid) else "")


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
    checkpoint_seconds: float = Field(
        10.0, ge=0.0, description="learned methods: least seconds between checkpoints, which an interrupted fit goes on from"
    )
    tensorboard: bool = Field(False, description="learned methods: event files beside the JSON lines (extra tensorboard)")


class MethodsConfig(Section):
    """Who is compared on the same split."""

    compare: tuple[str, ...] = Field(("svd-ridge", "mean", "nearest", "mlp"), description="entries of METHODS in the table")
    settings: dict[str, dict[str, Any]] = Field({}, description="a method's own settings, e.g. [methods.settings.mlp]")


class ReportConfig(Section):
    """What the report shows."""

    rows: int = Field(4, ge=1, le=64, description="held-out lightings shown as pictures")
    views: tuple[tuple[float, float, float], ...] = Field(
        (), description="places (metres) to see what is glossy, or the whole, from; none: as usual, and two near to gloss"
    )
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
    formats: tuple[Literal["exr", "exr-grid", "raw", "ktx2", "bytes", "bc6h", "bc6h-ktx2"], ...] = Field(
        ("exr",), min_length=1, description="files that basis textures are written to (docs/export.md)"
    )
    refit: bool = Field(True, description="fit the transfer to the textures as each format but exr holds them")
    engines: tuple[Literal["unity", "unreal", "godot", "three", "c"], ...] = Field(
        (), description="engines that get a folder with shader, loader and notes (docs/engines.md); brings the format raw"
    )
    gltf: bool = Field(
        False, description="write scene.glb, whose second texture coordinates are the lightmap's (docs/engines.md)"
    )
    gltf_preview: str = Field("", description="file of lightings, whose first is shown in scene.glb by MOZ_lightmap")

    @field_validator("formats", "engines")
    @classmethod
    def _each_once(cls, names: tuple[str, ...]) -> tuple[str, ...]:
        twice = next((name for name in names if names.count(name) > 1), None)
        if twice:
            raise ValueError(f'got "{twice}" more than once, expected every one once; leave the others out')
        return names

    @model_validator(mode="after")
    def _shown_somewhere(self) -> "ExportConfig":
        if self.gltf_preview and not self.gltf:
            raise ValueError(
                f'gltf_preview: got "{self.gltf_preview}" with gltf = false, expected true; set export.gltf = true'
            )
        return self


class BenchConfig(Section):
    """How `ddprt bench` measures the settings of [sweep]."""

    combine: Literal["each", "grid"] = Field(
        "each", description="each: every knob on its own about the configuration; grid: all combinations"
    )
    repeats: int = Field(5, ge=1, le=1000, description="timings of each stage but the bake; medians and spread are told")
    noise: float = Field(
        0.004, ge=1e-4, le=1.0, description="relative RMSE of the held-out maps that all settings are scored on"
    )
    path_frames: int = Field(24, ge=0, le=1000, description="frames of the light path that flicker is told of; 0 skips")
    pictures: int = Field(4, ge=0, description="held-out lightings seen by the camera for HDR-FLIP; 0 skips")
    keep: bool = Field(False, description="keep the datasets of the sweep when they have been measured")


class LeaguesConfig(Section):
    """How `ddprt bench --leagues` compares methods: under budgets of bytes, operations and seconds, on the same data."""

    methods: tuple[str, ...] = Field((), description="rivals of svd-ridge; empty: all but floors")
    seeds: int = Field(3, ge=1, le=100, description="deals of the training lightings, each with a search and a key of its own")
    trials: int = Field(8, ge=1, le=1000, description="settings that every method tries for each seed, its defaults the first")
    bytes: int = Field(0, ge=0, description="that may ship; 0: as many as svd-ridge's as configured")
    flops: int = Field(0, ge=0, description="operations that a frame may take; 0: likewise")
    seconds: float = Field(0.0, ge=0.0, description="that a fit may take without compiling; 0: 1.5 times svd-ridge's")


class BudgetConfig(Section):
    """What `ddprt eval --budget` takes apart, and how closely it looks."""

    lightings: int = Field(64, ge=4, description="held-out lightings that the error is taken apart on")
    noise: float = Field(0.004, ge=1e-4, le=1.0, description="relative RMSE of maps that count as free of noise")
    truth_samples: Literal["auto"] | Annotated[int, Field(ge=2, le=131072)] = Field(
        "auto", description="unbiased paths per texel of the truth, in two halves; auto: as noise asks"
    )
    abundance: int = Field(4, ge=1, le=64, description="so many times the training lightings count as all there are")
    scenario: dict[str, Any] = Field(
        {}, description="settings of [lightings] that the held-out ones differ in, e.g. {kinds = ['spot']}"
    )
    shadow_map: int = Field(512, ge=8, le=8192, description="texels per side of an engine's shadow maps")
    shadow_filter: int = Field(3, ge=1, le=15, description="taps per side of its percentage-closer filter")
    turn: bool = Field(True, description="turn the knob that is advised, and measure what it gains and costs")


class TuneConfig(Section):
    """The budget of `ddprt tune`; 0 sets no limit."""

    max_relative_rmse: float = Field(0.0, ge=0.0, description="error on held-out lightings")
    max_frame_us: float = Field(0.0, ge=0.0, description="microseconds to relight one frame")
    max_megabytes: float = Field(0.0, ge=0.0, description="10^6 bytes that ship")
    max_bake_seconds: float = Field(0.0, ge=0.0, description="seconds to bake what is learned from")
    max_fit_seconds: float = Field(0.0, ge=0.0, description="seconds to fit or train, compilation left out")
    trials: int = Field(12, ge=1, le=1000, description="settings that are really tried, at most")
