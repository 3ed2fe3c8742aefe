"""`ddprt bench --effects`: the same held-out lightings as planned, and once more without each effect that can be left out.

All variants have the same seeds, lightings and settings. What is compared is the light that a runtime answers with: indirect
light, and that of surfaces that glow. Seconds are medians over rounds in which all variants take their turn.
"""

import json
import shutil
import tempfile
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
from scipy.spatial import KDTree

from ddprt.axes import Float32, Int
from ddprt.bench.measure.trial import environment
from ddprt.config import Config
from ddprt.dataset.generate import bake
from ddprt.dataset.layers import Layer, LayerData, layers
from ddprt.dataset.splits import SPLITS, choose_lightings
from ddprt.dataset.store import Dataset
from ddprt.files import make_folder, write_text
from ddprt.lights import Lighting
from ddprt.progress import Progress, amount
from ddprt.scene.mesh import Scene
from ddprt.sections import PointsConfig
from ddprt.transport.configured import configured_scene
from ddprt.transport.effects import EFFECTS, force, plan
from ddprt.transport.embree import Tracer

SCHEMA = 1
PLANNED = "as planned"
_BOUNCES = "diffuse bounces"
_LIGHTINGS = 8  # held-out ones that are baked, at most
_ROUNDS = 3  # that are timed, at most
_NEAR = 1.5  # texels between a place and the same one on a lightmap of another shape
_SHARED = ("lightings", "atlas", "points")  # stages that take the same whatever is simulated


@dataclass(frozen=True)
class Variant:
    """One way to bake.

    Attributes:
      name: for the table.
      effect: that is left out or cut short; empty for none.
      bounces: as for `transport.bounces`.
    """

    name: str
    effect: str
    bounces: int

    def scene(self, planned: Scene) -> Scene:
        """The scene that it bakes."""
        return force(planned, off=[self.effect]) if self.effect not in ("", _BOUNCES) else planned


@dataclass(frozen=True)
class Row:
    """What a variant gives, beside the bake as planned.

    Attributes:
      variant, effect, why: what it is, which effect it lacks, and what the plan says of that.
      relative_rmse: of its light against that as planned; None where that is black, as are the next three.
      noise: relative RMSE that the noise of both makes by itself.
      energy_share: of all light as planned, what it lacks; below 0 where it has more.
      largest_change: anywhere under any lighting, as a share of that lighting's largest direct irradiance; noise included.
        None where no lamp lights anything.
      bound: what the plan says that this can be at most; None: unbounded.
      seconds: of the bake, median; without what takes the same whatever is simulated.
      rays: of the bake.
      layers: of each layer as planned, `relative_rmse` and `noise` as above; a bake that lacks it answers with darkness.
    """

    variant: str
    effect: str
    why: str
    relative_rmse: float | None
    noise: float | None
    energy_share: float | None
    largest_change: float | None
    bound: float | None
    seconds: float
    rays: int
    layers: dict[str, dict[str, float | None]] = field(default_factory=dict)


def ablation(config: Config, folder: Path, progress: Progress) -> list[Row]:
    """Bakes every variant, compares them, and writes effects.jsonl and effects.md.

    Args:
      config: of the whole; the first 8 of its held-out lightings are baked, and of `bench.repeats` rounds 3 at most are timed.
      folder: for these files, and for datasets while they are needed.
      progress: shown.
    Returns:
      A row for each variant, the bake as planned first.
    Raises:
      UserError: whatever hinders a bake.
    """
    scene = configured_scene(config)
    lightings = _lightings(scene, config)
    found = variants(scene, lightings["test"], config)
    make_folder(folder)
    rounds = 1 + min(config.bench.repeats, _ROUNDS)
    seconds: list[list[float]] = [[] for _ in found]
    rays, data = [0] * len(found), dict[int, Dataset]()
    with tempfile.TemporaryDirectory(prefix=".ddprt-effects-", dir=folder) as place:
        with progress.stage("effects", rounds * len(found)) as stage:
            for turn in range(rounds):  # the first one compiles, and tells light and rays alone
                for index, variant in enumerate(found):
                    own, out = Progress(quiet=True), Path(place) / f"{turn}-{index}"
                    baked = bake(variant.scene(scene), lightings, config=_settings(config, variant), out=out, progress=own)
                    if turn:
                        seconds[index].append(sum(float(s["seconds"]) for s in own.stages if s["name"] not in _SHARED))
                        shutil.rmtree(out)
                    else:
                        rays[index], data[index] = sum(int(s.get("rays", 0)) for s in own.stages), baked
                    stage.advance()
        rows = [
            _row(
                variant,
                scene,
                lightings["test"],
                data[0],
                data[index],
                median(seconds[index]),
                rays[index],
                config.probes.asked,
            )
            for index, variant in enumerate(found)
        ]
    about = {"schema": SCHEMA, "config": config.to_toml(), "environment": environment()}
    lines = [json.dumps({**asdict(row), **about}, allow_nan=False) for row in rows]
    write_text(folder / "effects.jsonl", "\n".join(lines) + "\n")
    write_text(folder / "effects.md", table(rows))
    return rows


def variants(scene: Scene, lightings: Sequence[Lighting], config: Config) -> list[Variant]:
    """As planned, without each effect that is called for and can be forced, and with fewer bounces where light bounces."""
    asked = config.transport.bounces
    planned = plan(scene, lightings, bounces=asked, probes=config.probes.asked)
    names = [effect.name for effect in planned.effects if effect.called and EFFECTS[effect.name].without]
    fewer = [count for count in (0, 1) if planned.bounces < 0 or count < planned.bounces]
    return [
        Variant(PLANNED, "", asked),
        *(Variant(f"without {name}", name, asked) for name in names),
        *(Variant(f"{count} bounce{'' if count == 1 else 's'}", _BOUNCES, count) for count in fewer),
    ]


def table(rows: Sequence[Row]) -> str:
    """The rows as Markdown, errors before seconds."""
    first = rows[0]
    lines = [
        "| bake | relative RMSE | noise | share of light | largest change | bound | seconds | of planned | rays |",
        "| --- | --- | --- | --- | --- | --- | --- | --- | --- |",
    ]
    for name in first.layers:
        lines = [f"{lines[0]} {name} | noise |", f"{lines[1]} --- | --- |"]
    for row in rows:
        shares = [row.relative_rmse, row.noise, row.energy_share, row.largest_change]
        told = ["-" if value is None or not row.effect else f"{value:.2%}" for value in shares]
        bound = "-" if not row.effect else "none" if row.bound is None else f"{row.bound:.2%}"
        took = [f"{row.seconds:.3g}", f"{row.seconds / first.seconds:.3g}" if first.seconds > 0 else "-", amount(row.rays)]
        parts = [part[key] for part in row.layers.values() for key in ("relative_rmse", "noise")]
        layered = ["-" if value is None or not row.effect else f"{value:.2%}" for value in parts]
        lines.append(f"| {' | '.join([row.variant, *told, bound, *took, *layered])} |")
    if len(rows) == 1:
        lines.append("\nNothing that is called for can be left out.")
    return "\n".join(lines) + "\n"


def _row(
    variant: Variant,
    scene: Scene,
    lightings: Sequence[Lighting],
    planned: Dataset,
    other: Dataset,
    seconds: float,
    rays: int,
    probes: str,
) -> Row:
    decided = plan(variant.scene(scene), lightings, bounces=variant.bounces, probes=probes)
    effect = next((effect for effect in decided.effects if effect.name == variant.effect), None)
    indices = planned.split("test")
    weight = planned.area[:, None] / planned.area.sum()
    place = counterparts(planned, other)
    energy, squares, changed, change, noise = np.zeros(5)
    largest: list[float] = []
    for index in indices:
        light, noisy = _light(planned, index), planned.maps("noise", [index])[0]
        there, unsure = (_there(values, place) for values in (_light(other, index), other.maps("noise", [index])[0]))
        energy += (weight * light).sum()
        squares += (weight * light.astype(np.float64) ** 2).sum()
        changed += (weight * (light - there)).sum()
        change += (weight * (light - there).astype(np.float64) ** 2).sum()
        noise += (weight * (noisy.astype(np.float64) ** 2 + unsure.astype(np.float64) ** 2)).sum()
        brightest = planned.maps("direct", [index]).max()
        if brightest > 0:
            largest.append(float(np.abs(light - there).max() / brightest))
    lit = squares > 0 and energy > 0
    return Row(
        variant.name,
        variant.effect,
        effect.why if effect else "",
        float(np.sqrt(change / squares)) if lit else None,
        float(np.sqrt(noise / squares)) if lit else None,
        float(changed / energy) if lit else None,
        max(largest, default=None) if lit else None,
        effect.bound if effect else 0.0,
        seconds,
        rays,
        {layer.name: _of_layer(planned, other, layer) for layer in layers(planned)},
    )


def _of_layer(planned: Dataset, other: Dataset, layer: Layer) -> dict[str, float | None]:
    """How far a layer's held-out light is from that as planned, and what noise makes of it; None where that is black."""
    own, indices = LayerData.of(planned, layer), planned.split("test")
    theirs = next((LayerData.of(other, found) for found in layers(other) if found.name == layer.name), None)
    dark = np.zeros((len(indices), len(own.area), 3), np.float32)

    def squares(light: np.ndarray) -> float:
        return float(np.einsum("lec,lec,e->", light, light, own.area, dtype=np.float64))

    def answered(part: LayerData | None) -> np.ndarray:
        """With the light of what glows, as a runtime answers."""
        light = part.maps("indirect", indices) if part else dark
        return light if part is None or part.constant is None else light + part.constant

    whole, there = answered(own), answered(theirs)
    unsure = [part.maps("noise", indices) if part else dark for part in (own, theirs)]
    total = squares(whole)
    if not total > 0:
        return {"relative_rmse": None, "noise": None}
    noise = sum(map(squares, unsure))
    return {"relative_rmse": float(np.sqrt(squares(whole - there) / total)), "noise": float(np.sqrt(noise / total))}


def counterparts(planned: Dataset, other: Dataset) -> Int[np.ndarray, " texels"]:
    """For each texel of one lightmap that of another at the same place of the surface; -1 where it has no such surface.

    Lightmaps that were unwrapped alike share their texels. Of others it is the nearest one that faces the same way.
    """
    if planned.uv is not None and other.uv is not None and np.array_equal(planned.uv, other.uv):
        slot = np.full(other.covered.shape, -1)
        slot[other.covered] = np.arange(np.count_nonzero(other.covered))
        return slot[planned.covered]
    edge = np.sqrt(np.median(planned.area))

    def places(data: Dataset) -> np.ndarray:
        return np.concatenate([data.gbuffer["position"] / edge, data.gbuffer["geometric_normal"]], 1, dtype=np.float64)

    _, found = KDTree(places(other)).query(places(planned), distance_upper_bound=_NEAR)
    return np.where(found < len(other.area), found, -1)


def _there(values: Float32[np.ndarray, "texels 3"], place: Int[np.ndarray, " others"]) -> Float32[np.ndarray, "others 3"]:
    return np.where(place[:, None] >= 0, values[place], np.float32(0))


def _light(data: Dataset, index: int) -> Float32[np.ndarray, "texels 3"]:
    """What a runtime answers with, W/m²."""
    light = data.maps("indirect", [index])[0]
    return light if data.constant is None else light + data.constant


def _lightings(scene: Scene, config: Config) -> dict[str, list[Lighting]]:
    """The first held-out lightings, and one of each other split, which nobody looks at."""
    settings = config.lightings.model_copy(update={"choose": "random", "target_error": 0.0})
    if not settings.file:  # each is drawn by itself
        settings = settings.model_copy(update={"train": 1, "validation": 1, "test": min(settings.test, _LIGHTINGS)})
    entries, _ = choose_lightings(None, settings, scene, Tracer.of(scene, config.transport.threads), config.seed)
    most = {"train": 1, "validation": 1, "test": _LIGHTINGS}
    return {name: [lighting for split, lighting in entries if split == name][: most[name]] for name in SPLITS}


def _settings(config: Config, variant: Variant) -> Config:
    """As configured for held-out maps; all else as cheap as can be."""
    cheap: dict[str, Any] = {"samples": 1, "footprint": 0.0, "adaptive": False, "denoise": False}
    lightings = config.lightings.model_copy(update={"choose": "random", "target_error": 0.0})
    transport = config.transport.model_copy(update={**cheap, "bounces": variant.bounces})
    points = PointsConfig(count=1, supersample=1, depth=0.0)
    return config.model_copy(update={"lightings": lightings, "transport": transport, "points": points})
