"""Hard cases with scenes and lights that bake.

Most rooms are closed and convex, so that light has closed forms in them: every lamp is seen from every wall, and where direct
light is even, so is indirect light, whatever rays are drawn. What stands beside `bound` says where it comes from.
"""

import json
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from hard_cases import HardCase, Outcome

import ddprt
from ddprt.config import Config
from ddprt.dataset.store import Dataset, map_name, write_map
from ddprt.errors import UserError
from ddprt.files import read_tensors, write_tensors
from ddprt.lights import Lighting, parse_lighting
from ddprt.methods.statuses import STATUSES
from ddprt.progress import Progress
from ddprt.runtime.model import Model
from ddprt.scene.checks import checked
from ddprt.scene.exr import read_exr, write_exr
from ddprt.scene.library import build
from ddprt.scene.mesh import Material, Scene
from ddprt.scene.shapes import faceted, hollow, icosphere
from ddprt.transport.embree import SELF_OFFSET

HALF, FLOAT = 2.0**-11, 2.0**-24
"""Unit roundoffs of what maps are stored in and of what light is computed in."""
FAINTEST = 2.0**-38
"""Spacing of a map's faintest halves, 2^-24, over the least that its brightest value is stored as, 2^14."""
SIGMAS = 6.0
"""Two-sided probability 2e-9 for a normal estimate: over all values that the cases look at, below 1e-5."""

ANY = frozenset(STATUSES) - {"no_signal", "diverged"}
"""Where light is judged, and not what a fit of four lamps says of itself."""
REFUSED, BLACK = frozenset({"refused"}), frozenset({"no_signal", "blind"})

Records = Sequence[dict[str, Any] | list[dict[str, Any]]]


# --- rooms, lamps and bakes -------------------------------------------------------------------------------------------


def room(albedo: float = 0.5, *, size: float = 1.0, at: float = 0.0) -> Scene:
    """A closed cube seen from inside; its coordinates are exact wherever size and place are powers of two."""
    planes = at + size * np.array([0.0, 1.0])
    return faceted("room", hollow(np.ones((1, 1, 1), bool), planes, planes, planes), (Material("wall", (albedo,) * 3),))


def point(x: float, y: float, z: float, *intensity: float) -> dict[str, Any]:
    red, green, blue = intensity * 3 if len(intensity) == 1 else intensity or (1.0, 1.0, 1.0)
    return {"type": "point", "position": [x, y, z], "intensity": [red, green, blue]}


LAMPS: Records = [point(0.5, 0.75, 0.5), point(0.25, 0.5, 0.25), point(0.75, 0.25, 0.5), point(0.5, 0.5, 0.75, 3.0, 2.0, 1.0)]
SUN = {"type": "directional", "direction": [0.0, -1.0, 0.0], "irradiance": [1.0, 1.0, 1.0]}


def baked(
    scene: Scene, records: Records, *, out: Path | None = None, progress: Progress | None = None, **sections: dict
) -> Dataset:
    """All lightings for training; validation and test repeat ordinary ones."""
    parsed = [parse_lighting(record) for record in records]
    given: dict[str, Sequence[Lighting]] = {"train": parsed, "validation": parsed[:1], "test": parsed[:1]}
    transport = {"samples": 16, "test_samples": 16, "direct_samples": 2, **sections.pop("transport", {})}
    points = {"count": 8, "supersample": 2, "depth": 0, **sections.pop("points", {})}  # so few that every lamp is near them
    settings = {"atlas": {"resolution": 16}, "points": points, **sections}
    config = Config.model_validate({**settings, "transport": transport})
    return ddprt.bake(scene, given, config=config, out=out, progress=progress)


def worst(*ratios: float | np.ndarray) -> float:
    """Largest of errors over bounds; infinity for what is no number."""
    flat = np.concatenate([np.ravel(ratio).astype(np.float64) for ratio in ratios])
    return float(np.where(np.isfinite(flat), flat, np.inf).max(initial=0))


def over(found: np.ndarray, expected: np.ndarray, bound: np.ndarray | float) -> np.ndarray:
    """Error over bound; no error over no bound is 0."""
    error = np.abs(np.asarray(found, np.float64) - expected)
    return np.divide(error, bound, out=np.where(error > 0, np.inf, 0.0), where=np.broadcast_to(bound, error.shape) > 0)


def alike(one: np.ndarray, other: np.ndarray) -> float:
    """0 for equal bits, infinity else."""
    return 0.0 if np.array_equal(one, other) else np.inf


def everything(data: Dataset) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Direct, measured and indirect light of all lightings."""
    indices = range(len(data.lightings))
    return data.maps("direct", indices), data.measured(indices), data.maps("indirect", indices)


def finite(*arrays: np.ndarray) -> bool:
    return all(bool(np.isfinite(array).all()) for array in arrays)


def refused(action: Callable[[], Any], *words: str) -> Outcome:
    """The outcome of what must be refused, in one line that has these words."""
    try:
        action()
    except UserError as error:
        line = str(error)
        return Outcome(0.0 if "\n" not in line and all(word in line for word in words) else np.inf, "refused")
    return Outcome(np.inf)


def from_lamp(scene: Scene, record: dict[str, Any], places: np.ndarray, normals: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Irradiance I cos(theta) / r² of a lamp that nothing hides, in float64, and the error that float32 may make of it.

    Rays start off the surface by `SELF_OFFSET` of the diagonal, and lamp and place are rounded to float32 about the centre:
    both move by at most `shift` in all. E = I n.d / |d|³ has a gradient of at most 4 I / |d|³, taken as near as it can be.
    Normals, cosine, strength and colour round some ten times more. Nearer than twice the shift nothing is known but the sign.
    """
    towards = np.array(record["position"]) - places
    distance = np.linalg.norm(towards, axis=1)
    reach = np.abs(np.array(record["position"]) - scene.centre).max() + scene.radius
    shift = 2 * SELF_OFFSET * scene.radius + 2 * np.sqrt(3) * FLOAT * reach
    with np.errstate(divide="ignore", invalid="ignore"):
        irradiance = np.maximum((normals * towards).sum(1), 0) / distance**3
        slope = np.where(distance > 2 * shift, 4 * shift / np.maximum(distance - shift, 0) ** 3, np.inf)
        bound = slope + 10 * FLOAT / distance**2
    intensity = np.array(record["intensity"], np.float64)
    return np.nan_to_num(irradiance)[:, None] * intensity, np.nan_to_num(bound, nan=np.inf, posinf=np.inf)[:, None] * intensity


# --- bounces ----------------------------------------------------------------------------------------------------------


def furnace_range(scene: Scene) -> tuple[float, float]:
    """Least and most direct light of a lamp of 1 W/sr in the middle: E = h / r³ with h the distance of a face's plane."""
    corners = scene.corners
    height = np.abs((corners[:, 0] * scene.geometric_normals).sum(1))
    return float((height / np.linalg.norm(corners, axis=2).max(1) ** 3).min()), float((height**-2).max())


def within(found: np.ndarray, low: float, high: float) -> float:
    """How far values lie from the middle of a range, over half its width; halves and their floats widen it."""
    low, high = low * (1 - 4 * HALF), high * (1 + 4 * HALF)  # direct light is stored and read, and so is the result
    return worst(over(found, np.full(found.shape, (low + high) / 2), (high - low) / 2))


MIDDLE: Records = [point(0, 0, 0)]


def white_furnace(albedo: float, **transport: Any) -> Outcome:
    """Even light bounces evenly: rows of G sum to 1, so every value lies in the range of E0 times a + ... + a^bounces."""
    scene, progress = build("furnace", albedo=albedo, subdivisions=2), Progress(quiet=True)
    data = baked(scene, MIDDLE, progress=progress, atlas={"resolution": 32, "padding": 1}, transport=transport)
    low, high = furnace_range(scene)
    direct, measured, indirect = everything(data)
    facts = next(stage for stage in progress.stages if stage["name"] == "indirect train")
    bounces = int(facts.get("bounces", 0))
    series = sum(albedo**k for k in range(1, bounces + 1))
    whole = albedo / (1 - albedo) if albedo < 1 else np.inf
    if facts.get("remainder", "0") == "unbounded":
        missed = 0.0 if albedo == 1 else np.inf
    else:
        left = float(facts.get("remainder", "0")) * indirect.max()
        missed = worst(over(np.array(max(low * whole - indirect.max(), 0.0)), np.array(0.0), left + 4 * HALF * whole))
    return Outcome(
        worst(within(direct, low, high), within(indirect, low * series, high * series), missed),
        finite=finite(direct, measured, indirect),
    )


def _nothing_bounces(scene: Scene, record: dict[str, Any], **sections: dict) -> Outcome:
    direct, measured, indirect = everything(baked(scene, [record], **sections))
    return Outcome(np.inf if indirect.any() or not direct.any() else 0.0, finite=finite(direct, measured))


def _bright_room_by_paths() -> Outcome:
    albedo = 0.999
    scene, samples = build("furnace", albedo=albedo, subdivisions=2), 128
    low, high = furnace_range(scene)
    places, normals = scene.corners[::40].mean(1), scene.geometric_normals[::40]
    _, indirect, _, variance = ddprt.irradiance(scene, MIDDLE, places, normals, samples=samples, return_variance=True)
    # All places estimate one number, but for the range of E0: their mean has the variance of the mean.
    spread = np.sqrt(variance[:, 0].sum()) / len(places)
    middle, half = (low + high) / 2 * albedo / (1 - albedo), (high - low) / 2 * albedo / (1 - albedo)
    return Outcome(worst(over(indirect[:, 0].mean(), middle, half + SIGMAS * spread)), finite=finite(indirect))


# --- where lamps stand ------------------------------------------------------------------------------------------------


def lamp_at(record: dict[str, Any], *, dark: bool = False, scene: Scene | None = None) -> Outcome:
    """Measured light against the closed form (nothing, if `dark`); maps are finite, and dark where they must be."""
    scene = scene or room()
    ordinary = LAMPS[0] if scene.name == "room" else point(0.28, 0.45, 0.28)
    data = baked(scene, [ordinary, record], atlas={"resolution": 16 if scene.name == "room" else 32})
    direct, measured, indirect = everything(data)
    expected, bound = from_lamp(scene, record, data.samples.position, data.samples.normal)
    known = np.isfinite(bound)
    if dark:
        return Outcome(0.0 if not (direct[1].any() or measured[1].any() or indirect[1].any()) else np.inf)
    ratio = over(np.where(known, measured[1], 0), np.where(known, expected, 0), np.where(known, bound, 1))
    lit = 0.0 if direct[1].any() and indirect[1].any() else np.inf
    return Outcome(worst(ratio, lit), finite=finite(direct, measured, indirect))


def _barely_behind() -> Outcome:
    """A micrometre outside, rays from far walls stop short of the wall between: the lamp counts as in it."""
    record = point(0.5, -1e-6, 0.5)
    found, _ = ddprt.irradiance(room(), record, [[0.5, 1.0, 0.5]], [[0.0, -1.0, 0.0]], samples=2)
    expected, bound = from_lamp(room(), record, np.array([[0.5, 1.0, 0.5]]), np.array([[0.0, -1.0, 0.0]]))
    return Outcome(worst(over(found, expected, bound)), finite=finite(found))


def _far_lamp() -> Outcome:
    """A cube and a lamp 1e6 m above: its top gets I cos / r², its sides what grazes them, its bottom nothing."""
    record, scene = point(0.0, 1e6, 0.0, 1e12), build("convex")
    places = np.array([[0.25, 0.5, 0.25], [0.0, -0.5, 0.0]])
    normals = np.array([[0.0, 1.0, 0.0], [0.0, -1.0, 0.0]])
    found, indirect = ddprt.irradiance(scene, record, places, normals, samples=2)
    expected, bound = from_lamp(scene, record, places, normals)
    data = baked(scene, [record])
    return Outcome(worst(over(found, expected, bound), 0.0 if not indirect.any() else np.inf), finite=finite(*everything(data)))


def _in_a_block() -> Outcome:
    return lamp_at(point(0.186, 0.08, 0.169), dark=True, scene=build("cornell"))


# --- scale, place and strength ----------------------------------------------------------------------------------------


def moved(records: Records, size: float = 1.0, at: float = 0.0, strength: float = 1.0) -> list[dict[str, Any]]:
    return [
        {
            **record,
            "position": [at + size * x for x in record["position"]],
            "intensity": [strength * x for x in record["intensity"]],
        }
        for record in records
        if isinstance(record, dict)
    ]


def fitted(data: Dataset, records: Records, **settings: Any) -> tuple[Model, np.ndarray]:
    model = ddprt.fit(data, bases=3, **settings)
    return model, np.stack([model.relight(record) for record in records])


def of_another_size(exponent: int) -> Outcome:
    """Powers of two change no mantissa: light is 4^-exponent times as bright, bit for bit, up to the relit map."""
    here, there = moved(LAMPS), moved(LAMPS, 2.0**exponent)
    one, other = baked(room(), here), baked(room(size=2.0**exponent), there)
    pairs = list(zip(everything(one), everything(other), strict=True))
    pairs.append((fitted(one, here)[1], fitted(other, there)[1]))
    return Outcome(
        worst(*(alike(np.ldexp(a, -2 * exponent), b) for a, b in pairs)),
        finite=finite(*(array for pair in pairs for array in pair)),
    )


def of_another_strength(exponent: int) -> Outcome:
    """Equal bits again, up to the relit map; what falls below the least normal number of float32 there may be flushed."""
    here, there = moved(LAMPS), moved(LAMPS, strength=2.0**exponent)
    one, other = baked(room(), here), baked(room(), there)
    pairs = list(zip(everything(one), everything(other), strict=True))
    relit, brighter = fitted(one, here)[1], fitted(other, there)[1]
    ratios = [alike(np.ldexp(a, exponent), b) for a, b in pairs]
    ratios.append(worst(over(brighter, np.ldexp(relit.astype(np.float64), exponent), 2.0**-126)))
    return Outcome(worst(*ratios), finite=finite(brighter, *(b for _, b in pairs)))


def _far_away() -> Outcome:
    """Coordinates are dyadic, so the room and its lamps are the same about its centre: equal maps, bit for bit.

    Samples are placed in world space: they move by at most the spacing of float64 there, far below the shift of `from_lamp`.
    """
    at = 2.0**14
    one, other = baked(room(), moved(LAMPS)), baked(room(at=at), moved(LAMPS, at=at))
    (direct, _, indirect), (direct_there, measured, indirect_there) = everything(one), everything(other)
    ratios = [alike(direct, direct_there), alike(indirect, indirect_there)]
    for light, record in zip(measured, moved(LAMPS, at=at), strict=False):
        expected, bound = from_lamp(room(at=at), record, other.samples.position, other.samples.normal)
        ratios.append(worst(over(light, expected, bound)))
    return Outcome(worst(*ratios), finite=finite(direct_there, measured, indirect_there))


def _dark_lamp() -> Outcome:
    data = baked(room(), [*LAMPS[:3], point(0.5, 0.5, 0.5, 0.0)])
    _, relit = fitted(data, [point(0.5, 0.5, 0.5, 0.0)])
    zero = [array[3] for array in everything(data)]
    return Outcome(0.0 if not any(array.any() for array in (*zero, relit)) else np.inf, finite=finite(relit))


def added(one: dict[str, Any], other: dict[str, Any]) -> Outcome:
    """E(a + b) = E(a) + E(b): the same rays for all lightings of a bake.

    Halves round each of three maps once, and once more the direct light that they were gathered from; what is fainter than
    2^-29 of a map's peak has the spacing of its faintest halves. Sums in float32 are of at most 4096 values of one sign.
    """
    data = baked(room(), [one, other, [one, other]])
    ratios = []
    for stored, light in zip((True, False, True), everything(data), strict=True):
        light = light.astype(np.float64)
        total = light[0] + light[1]
        peaks = light[:3].max((1, 2)).sum()
        bound = (4 * HALF + 4096 * FLOAT) * total + 2 * FAINTEST * peaks if stored else 8 * FLOAT * total
        ratios.append(worst(over(light[2], total, bound)))
    return Outcome(worst(*ratios), finite=finite(light))


def _red() -> Outcome:
    red = [{**record, "intensity": [record["intensity"][0], 0.0, 0.0]} for record in LAMPS]  # type: ignore[call-overload]
    data = baked(room(), red)
    light = [*everything(data), fitted(data, red)[1], fitted(data, red, channels="multi")[1]]
    clean = all(array[..., 0].any() and not array[..., 1:].any() for array in light)
    return Outcome(0.0 if clean else np.inf, finite=finite(*light))


def _past_half() -> Outcome:
    """A lamp 1 m off three walls and as strong as a lighthouse: values past 65504 keep the eleven bits of a half."""
    strong = point(0.5, 0.5, 0.5, 2.0**24)
    data = baked(room(), [LAMPS[0], strong], transport={"direct_samples": 64})
    direct, measured, indirect = everything(data)
    # Every wall sees the lamp from 0.5 m: E lies between those of a corner and of the middle, and the texel is their mean.
    low, high = (0.5 / np.array([0.75**1.5, 0.5**3])) * 2.0**24
    inside = within(direct[1], low, high)
    return Outcome(worst(inside, 0.0 if direct[1].max() > 65504 else np.inf), finite=finite(direct, measured, indirect))


# --- kinds of light ---------------------------------------------------------------------------------------------------


def spot_of(outer: float, inner: float) -> Outcome:
    """A spot a metre above points across its rim, against the falloff of glTF in float64.

    1 - cosine is half the square of the chord between the axis and the direction. Rounding moves the direction by at most
    2 units, so that this is off by 2 units times the chord (and their square), the falloff by that over the rim's width.
    """
    reach = min(1.2 * outer, 89.95)
    places = np.zeros((200, 3), np.float32)
    places[:, 0] = np.tan(np.radians(np.linspace(0, reach, 201)[1:]))
    record = {"type": "spot", "position": [0, 1, 0], "direction": [0, -1, 0], "intensity": [1, 1, 1]}
    (spot,) = parse_lighting({**record, "outer_deg": outer, "inner_deg": inner})
    found = spot.illuminate(places, np.zeros((200, 2), np.float32)).strength
    across = places[:, 0].astype(np.float64)
    drop, rim, full = (2 * np.sin(angle / 2) ** 2 for angle in (np.arctan(across), *np.radians([outer, inner])))
    falloff, light = np.clip((rim - drop) / (rim - full), 0, 1), 1 / (1 + across**2)
    moves = (np.sqrt(2 * drop) * 2 * FLOAT + (2 * FLOAT) ** 2) / (rim - full)
    return Outcome(
        worst(over(found, falloff**2 * light, light * (2 * falloff * moves + moves**2 + 3 * FLOAT))), finite=finite(found)
    )


def _tiny_ball() -> Outcome:
    """A sphere of 1 µm is a lamp of pi r² L: from 0.1 m on the ball's own size changes E by at most (r / d)² = 1e-10."""
    radius, lamp = 1e-6, point(0.5, 0.75, 0.5)
    glow = {"type": "sphere", "center": lamp["position"], "radius": radius, "radiance": [1 / (np.pi * radius**2)] * 3}
    data = baked(room(), [glow])
    expected, bound = from_lamp(room(), lamp, data.samples.position, data.samples.normal)
    return Outcome(worst(over(data.measured([0])[0], expected, bound + 1e-10 * expected)), finite=finite(*everything(data)))


def _touching_ball() -> Outcome:
    """A ball that lies on the floor is wholly above the horizon of all of it: E = pi L (r / d)² cos(theta), in the mean."""
    ball = {"type": "sphere", "center": [0.5, 0.25, 0.5], "radius": 0.25, "radiance": [1.0, 1.0, 1.0]}
    scene, across = room(), np.array([0.02, 0.1, 0.2, 0.3, 0.45])
    places = np.stack([0.5 + across, 0 * across, 0 * across + 0.5], 1)
    normals = np.tile([0.0, 1.0, 0.0], (5, 1))
    found, indirect, variance, _ = ddprt.irradiance(scene, ball, places, normals, samples=4096, return_variance=True)
    towards = np.array([0.5, 0.25, 0.5]) - places
    squared = (towards**2).sum(1)
    expected = np.pi * 0.25**2 * (towards * normals).sum(1) / squared**1.5
    # Near the touching point half the ball is within the rays' offset of the horizon; the shift counts as for a lamp.
    shift = 4 * (2 * SELF_OFFSET * scene.radius + 4 * FLOAT) * np.pi / np.sqrt(squared)
    return Outcome(worst(over(found[:, 0], expected, SIGMAS * np.sqrt(variance[:, 0]) + shift)), finite=finite(found, indirect))


def _ball_around_everything() -> Outcome:
    ball = {"type": "sphere", "center": [0.5, 0.5, 0.5], "radius": 2.0, "radiance": [1.0, 1.0, 1.0]}
    return refused(lambda: baked(room(), [ball]), "light nothing")


def _grazing_sun() -> Outcome:
    """Light along a wall that is turned to no axis: n.d is 0 but for the rounding of six numbers and of five operations."""
    turn = np.radians(33)
    along = np.array([np.cos(turn), np.sin(turn), 0.0])
    normal = np.array([-np.sin(turn), np.cos(turn), 0.0])
    up = np.array([0.0, 0.0, 1.0])
    corners = np.array([[0 * up, up, along + up, along]])
    if np.cross(corners[0, 1] - corners[0, 0], corners[0, 2] - corners[0, 0]) @ normal < 0:
        corners = corners[:, ::-1]
    wall = faceted("wall", corners, (Material("grey", (0.5,) * 3),))
    sun = {"type": "directional", "direction": along.tolist(), "irradiance": [1.0, 1.0, 1.0]}
    found, _ = ddprt.irradiance(wall, sun, [0.5 * along + 0.5 * up], [normal], samples=2)
    return Outcome(worst(over(found, np.zeros(3), 11 * FLOAT)), finite=finite(found))


def _edge_on() -> Outcome:
    """The wall in whose plane a rectangle lies gets nothing from it, the opposite of which it shows its back nothing either."""
    lamp = {"type": "rect", "center": [0.0, 0.5, 0.5], "half_u": [0, 0.125, 0], "half_v": [0, 0, 0.125], "radiance": [1.0] * 3}
    places, normals = np.array([[0.0, 0.9, 0.5], [1.0, 0.5, 0.5]]), np.array([[1.0, 0, 0], [-1.0, 0, 0]])
    facing, _ = ddprt.irradiance(room(), lamp, places, normals, samples=64)
    back = {**lamp, "half_u": [0, -0.125, 0]}
    away, _ = ddprt.irradiance(room(), back, places, normals, samples=64)
    dark = not facing[0].any() and not away.any() and bool(facing[1].all())
    return Outcome(0.0 if dark else np.inf, finite=finite(facing, away))


def in_json(record: dict[str, Any], *words: str) -> Outcome:
    """A file of lightings that must be refused; JSON as Python writes it says NaN and Infinity."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "lights.json"
        path.write_text(json.dumps([[record]]))
        return refused(lambda: ddprt.load_lightings(path), path.name, *words)


# --- geometry ---------------------------------------------------------------------------------------------------------


def even(scene: Scene, albedo: float = 0.5) -> Outcome:
    """A closed room that direct light fills evenly stays even: see `white_furnace`. What faces outwards is dark."""
    data = baked(scene, MIDDLE, atlas={"resolution": 48, "padding": 1})
    low, high = furnace_range(scene)
    direct, measured, indirect = everything(data)
    outside = (data.gbuffer["position"] * data.gbuffer["geometric_normal"]).sum(1) > 0
    dark = not direct[:, outside].any() and not indirect[:, outside].any()
    direct, indirect, whole = direct[:, ~outside], indirect[:, ~outside], albedo / (1 - albedo)
    return Outcome(
        worst(within(direct, low, high), within(indirect, low * whole * (1 - 1e-3), high * whole), 0.0 if dark else np.inf),
        finite=finite(direct, measured, indirect),
    )


def split_again(every: int, *, opposed: bool = False) -> Scene:
    """The furnace with some of its triangles once more, cut at their middle, facing the same way or the other."""
    directions, outward = icosphere(2)
    inward = outward[:, ::-1]
    chosen = inward[::every]
    middle = len(directions) + np.arange(len(chosen))
    a, b, c = chosen.T
    copies = np.concatenate([np.stack(part, 1) for part in ((a, b, middle), (b, c, middle), (c, a, middle))])
    positions = np.concatenate([directions, directions[chosen].mean(1)])
    # Vertices of their own: joined to the first surface, they would be turned to its winding.
    copies = copies[:, ::-1] if opposed else copies
    apart = np.concatenate([positions, positions[copies].reshape(-1, 3)])
    fresh = len(positions) + np.arange(3 * len(copies)).reshape(-1, 3)
    used, faces = np.unique(np.concatenate([inward, fresh]), return_inverse=True)
    return checked("split", apart[used], faces.reshape(-1, 3), materials=(Material("wall", (0.5,) * 3),))


def cleaned(extra: np.ndarray, note: str) -> Outcome:
    """Triangles that are no surface are taken out, and said; what is left bakes to the same bits."""
    clean = room()
    positions = np.concatenate([clean.positions, extra.reshape(-1, 3)])
    fresh = len(clean.positions) + np.arange(len(extra) * 3).reshape(-1, 3)
    normals = np.concatenate([clean.normals, np.tile([0.0, 1.0, 0.0], (len(extra) * 3, 1))])
    faces = np.concatenate([clean.triangles, fresh])
    dirty = checked("room", positions, faces, normals=normals, materials=clean.materials)
    ratios = [alike(a, b) for a, b in zip(everything(baked(clean, LAMPS)), everything(baked(dirty, LAMPS)), strict=True)]
    return Outcome(worst(*ratios, 0.0 if any(note in line for line in dirty.notes) else np.inf))


def _slivers() -> Outcome:
    """The room's floor cut into needles two hundred times as long as wide, fanned out from one corner.

    Light at the measurement points is that of a plain room; a needle's normal is as exact as its corners.
    """
    quads = hollow(np.ones((1, 1, 1), bool), *(np.array([0.0, 1.0]),) * 3)
    flat = (quads[..., 1] == 0).all(1)
    edge = np.linspace(0, 1, 201)
    rim = np.stack([np.ones_like(edge), 0 * edge, edge], 1)
    fan = np.stack([np.zeros((200, 3)), rim[1:], rim[:-1]], 1)
    rest = np.array([[[0.0, 0, 0], [0, 0, 1], [1, 0, 1]]])
    walls = quads[~flat][:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3, 3)
    triangles = np.concatenate([walls, fan, rest])
    scene = checked("needles", triangles.reshape(-1, 3), np.arange(3 * len(triangles)).reshape(-1, 3))
    data = baked(scene, LAMPS, atlas={"resolution": 32})
    ratios = [0.0 if abs(scene.areas.sum() - 6) < 1e-12 else np.inf]
    for light, record in zip(data.measured(range(len(LAMPS))), moved(LAMPS), strict=True):
        expected, bound = from_lamp(scene, record, data.samples.position, data.samples.normal)
        ratios.append(worst(over(light, expected, bound)))
    return Outcome(worst(*ratios), finite=finite(*everything(data)))


def _texels_of_no_area() -> Outcome:
    """Crumbs next to nothing in a corner, just large enough not to be taken out: nothing divides by their area."""
    clean, size = room(), 3e-8
    crumb = np.array([[0.5, 0.5, 0.5], [0.5, 0.5, 0.5 + 1], [0.5 + size, 0.5, 0.5]])
    scene = checked(
        "crumbs",
        np.concatenate([clean.positions, crumb]),
        np.concatenate([clean.triangles, len(clean.positions) + np.arange(3)[None]]),
        materials=clean.materials,
    )
    data = baked(scene, [point(0.5, 0.75, 0.25), *LAMPS[1:]])
    light = everything(data)
    kept = len(scene.triangles) == len(clean.triangles) + 1
    return Outcome(0.0 if kept and (data.area > 0).all() else np.inf, finite=finite(*light, data.area))


def _one_triangle() -> Outcome:
    scene = checked("one", np.array([[0.0, 0, 0], [0, 0, 1], [1, 0, 0]]), np.array([[0, 1, 2]]))
    return _nothing_bounces(scene, point(0.25, 1.0, 0.25), points={"count": 4, "supersample": 2})


# --- measurement points -----------------------------------------------------------------------------------------------


def given_points(
    scene: Scene, entries: list[dict[str, Any]], lamps: Records, relit: Records
) -> tuple[Dataset, np.ndarray, str]:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "points.json"
        path.write_text(json.dumps(entries))
        places = {"file": str(path), "count": len(entries), "supersample": 1}
        data = baked(scene, lamps, points=places, atlas={"resolution": 16 if scene.name == "room" else 32})
        model, images = fitted(data, relit)
        return data, images, model.relighter.report.status


def _points_inside() -> Outcome:
    """All points in what is solid: they measure nothing, the model is black, and its status says so."""
    entries = [{"position": [0.1 + 0.1 * k, -0.5, 0.5], "normal": [0, 1, 0]} for k in range(8)]
    data, images, status = given_points(room(), entries, LAMPS, LAMPS)
    return Outcome(0.0 if not (images.any() or data.measured(range(4)).any()) else np.inf, status, finite(images))


def _hull_of_a_room() -> Outcome:
    """A room's hull looks outwards: no lamp inside reaches it."""
    data = baked(room(), LAMPS, points={"count": 8, "supersample": 2, "on": "hull"})
    model, images = fitted(data, LAMPS)
    dark = not (images.any() or data.measured(range(4)).any())
    return Outcome(0.0 if dark else np.inf, model.relighter.report.status, finite(images))


def _seen_by_no_point() -> Outcome:
    """Points on the ceiling, a spot on the floor: what no point sees trains nothing, and is relit as exactly nothing."""
    entries = [{"position": [0.1 + 0.1 * k, 1.0, 0.5], "normal": [0, -1, 0]} for k in range(8)]
    spot = {**point(0.5, 0.5, 0.5), "type": "spot", "direction": [0, -1, 0], "inner_deg": 10, "outer_deg": 30}
    data, images, status = given_points(room(), entries, [*LAMPS[:3], spot], [*LAMPS[:3], spot])
    lit = bool(data.maps("indirect", [3]).any()) and not data.measured([3]).any()
    return Outcome(0.0 if lit and not images[-1].any() and images[0].any() else np.inf, status, finite(images))


def _points_at_one_place() -> Outcome:
    """Each of three points at one place measures what is there, and not nothing."""
    entries = [{"position": [0.1 + 0.1 * max(k, 2), 0.0, 0.5], "normal": [0, 1, 0]} for k in range(8)]
    data, images, status = given_points(room(), entries, LAMPS, LAMPS)
    values = data.values(range(4), 8, "irradiance")
    same = alike(values[:, 0], values[:, 1]) + alike(values[:, 0], values[:, 2])
    return Outcome(worst(same, 0.0 if values.all() else np.inf), status, finite(images))


# --- files ------------------------------------------------------------------------------------------------------------


def spoilt(kind: str, value: float, *words: str) -> Outcome:
    """One bad number in a finished dataset on disk: refused by name of file, before anything is learned from it."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "dataset"
        data = baked(room(), LAMPS, out=out)
        if kind == "measured":
            path = out / map_name(kind, 1)
            values = read_tensors(path)["irradiance"].copy()
            values[3, 1] = value
            write_tensors(path, {"irradiance": values})
        else:
            path = out / "atlas" / "area.exr" if kind == "area" else out / map_name(kind, 1)
            image, header = read_exr(path)
            image[tuple(np.argwhere(data.covered)[7])] = value
            _write_raw(path, image, {key: text for key, text in header.items() if key.startswith("ddprt")})
        return refused(lambda: ddprt.fit(ddprt.open_dataset(out)), path.name, *words)


def _write_raw(path: Path, image: np.ndarray, attributes: dict[str, str]) -> None:
    """As another program would: without a look at the values."""
    import OpenEXR

    name = "RGB" if image.shape[2] == 3 else "Y"
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage, **attributes}
    OpenEXR.File(header, {name: image if name == "RGB" else image[..., 0].copy()}).write(str(path))


def _bad_exposure() -> Outcome:
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "dataset"
        baked(room(), LAMPS, out=out)
        path = out / map_name("indirect", 1)
        write_exr(path, read_exr(path)[0], half=True, attributes={"ddprt_exposure": "4000"})
        return refused(lambda: ddprt.fit(ddprt.open_dataset(out)), path.name, "infinity")


def _wide_map() -> Outcome:
    """From 1e-6 to 1e6: nearly nine decades below the peak keep the bits of a half, the rest the spacing of its faintest."""
    image = np.geomspace(1e-6, 1e6, 16 * 16 * 3).reshape(16, 16, 3).astype(np.float32)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "map.exr"
        write_map(path, image)
        found = ddprt.dataset.store.read_map(path)
    return Outcome(worst(over(found, image, HALF * image + FAINTEST / 2 * 1e6)), finite=finite(found))


def _past_float_at_a_point() -> Outcome:
    """0.02 mm above a measurement point 1e30 W/sr give more than float32 holds, and nowhere on the texels."""
    entries = [{"position": [0.3, 0.0, 0.3], "normal": [0, 1, 0]}, {"position": [0.7, 0.0, 0.7], "normal": [0, 1, 0]}]
    return refused(lambda: given_points(room(), entries, [point(0.3, 2e-5, 0.3, 1e30)], LAMPS), "float32", "point")


def _past_float() -> Outcome:
    """In a room of a micrometre E is 1e42 and more, everywhere."""
    return refused(lambda: baked(room(size=2.0**-20), [point(*[2.0**-21] * 3, 1e30)]), "float32")


CASES: tuple[HardCase, ...] = (
    HardCase("black furnace", "no surface reflects", "indirect light is exactly 0", lambda: white_furnace(0.0)),
    HardCase(
        "grey furnace", "every ray hits, light is even", "E0 a / (1 - a), whatever rays are drawn", lambda: white_furnace(0.5)
    ),
    HardCase(
        "bright furnace",
        "albedo 0.999: the series hardly converges",
        "a + ... + a^n, and a / (1 - a) within the remainder that is reported",
        lambda: white_furnace(0.999),
    ),
    HardCase(
        "white furnace",
        "albedo 1: the series does not converge",
        "n E0, and the remainder is called unbounded",
        lambda: white_furnace(1.0),
    ),
    HardCase(
        "bright furnace by paths",
        "weights grow where roulette ends paths more often than walls do",
        "a / (1 - a) within six standard errors that are reported",
        _bright_room_by_paths,
    ),
    HardCase(
        "lone convex object",
        "nothing faces anything",
        "indirect light is exactly 0",
        lambda: _nothing_bounces(build("convex"), point(0.0, 2.0, 0.25)),
    ),
    HardCase("one triangle", "the least scene there is", "indirect light is exactly 0", _one_triangle),
    HardCase(
        "black room",
        "light arrives and none leaves",
        "indirect light is exactly 0",
        lambda: _nothing_bounces(room(0.0), LAMPS[0]),
    ),  # type: ignore[arg-type]
    HardCase(
        "lamp on a wall", "its distance to that wall is 0", "I cos / r² on all others", lambda: lamp_at(point(0.5, 0.0, 0.5))
    ),
    HardCase(
        "lamp at a vertex", "three walls meet in it", "I cos / r² on the other three", lambda: lamp_at(point(0.0, 0.0, 0.0))
    ),
    HardCase(
        "lamp a micrometre off a wall",
        "nearer than rays start",
        "I cos / r² within the offset of rays",
        lambda: lamp_at(point(0.5, 1e-6, 0.5)),
    ),
    HardCase(
        "lamp a micrometre behind a wall",
        "nearer than rays stop short",
        "I cos / r² or nothing, to either side of the wall",
        _barely_behind,
    ),
    HardCase(
        "lamp behind a wall",
        "walls are blind from behind",
        "exactly nothing",
        lambda: lamp_at(point(0.5, -0.25, 0.5), dark=True),
    ),
    HardCase(
        "lamp a thousand kilometres away",
        "float32 has 0.06 m there",
        "a distant lamp lights what is convex as I cos / r²",
        _far_lamp,
    ),
    HardCase("lamp in a block", "its light never leaves", "exactly nothing", _in_a_block),
    HardCase(
        "room of 0.1 mm", "absolute tolerances would show", "equal bits but for the power of two", lambda: of_another_size(-13)
    ),
    HardCase(
        "room of 100 km", "absolute tolerances would show", "equal bits but for the power of two", lambda: of_another_size(17)
    ),
    HardCase("room 16 km away", "float32 has 1 mm there", "equal maps, bit for bit", _far_away),
    HardCase(
        "intensity of 1e-30", "squares underflow", "equal bits but for the power of two", lambda: of_another_strength(-99)
    ),
    HardCase("intensity of 1e30", "squares overflow", "equal bits but for the power of two", lambda: of_another_strength(98)),
    HardCase("intensity 0", "a column of zeros", "exactly nothing, relit too", _dark_lamp),
    HardCase(
        "two lamps", "three columns of two lamps", "E(a + b) = E(a) + E(b) up to rounding", lambda: added(LAMPS[1], LAMPS[2])
    ),  # type: ignore[arg-type]
    HardCase(
        "two lamps, one 1e6 times brighter",
        "the dim one is far below the bright one's peak",
        "E(a + b) = E(a) + E(b) up to rounding",
        lambda: added(point(0.25, 0.5, 0.25, 1e6), point(0.75, 0.25, 0.5)),
    ),
    HardCase(
        "lamp 2 mm off a wall beside another",
        "one map spans a million to one",
        "E(a + b) = E(a) + E(b) up to rounding of each value",
        lambda: added(point(0.5, 0.002, 0.5), point(0.75, 0.5, 0.5)),
    ),
    HardCase("pure red lamps", "two channels of zeros", "green and blue exactly 0 through the whole chain", _red),
    HardCase("values past half floats", "halves end at 65504", "eleven bits, under an exposure", _past_half),
    HardCase("HDR map", "twelve decades in one map", "eleven bits down to 2e-9 of the peak", _wide_map),
    HardCase("light past float32", "1e30 W/sr in a room of a micrometre", "refused", _past_float, REFUSED),
    HardCase(
        "light past float32 at a point",
        "the maps are finite, what is measured is not",
        "refused",
        _past_float_at_a_point,
        REFUSED,
    ),
    HardCase(
        "spot of 0.1 degrees",
        "1 - cosine is 1.5e-6",
        "glTF falloff within what float32 directions allow",
        lambda: spot_of(0.1, 0.05),
    ),
    HardCase(
        "spot with a rim of 0.001 degrees",
        "inner and outer cosine agree to 3e-9",
        "glTF falloff within what float32 directions allow",
        lambda: spot_of(0.1, 0.099),
    ),
    HardCase(
        "spot of 89.9 degrees",
        "nearly a half space",
        "glTF falloff within what float32 directions allow",
        lambda: spot_of(89.9, 0.0),
    ),
    HardCase(
        "spot without a rim",
        "inner = outer divides by zero",
        "refused",
        lambda: in_json(
            {**point(0, 0, 0), "type": "spot", "direction": [0, 1, 0], "inner_deg": 30, "outer_deg": 30}, "inner_deg"
        ),
        REFUSED,
    ),
    HardCase(
        "rectangle without area",
        "it has no normal",
        "refused",
        lambda: in_json(
            {"type": "rect", "center": [0, 0, 0], "half_u": [1, 0, 0], "half_v": [2, 0, 0], "radiance": [1, 1, 1]}, "half_u"
        ),
        REFUSED,
    ),
    HardCase("rectangle edge-on", "its cosine is 0 within a wall and from behind", "exactly nothing there", _edge_on),
    HardCase("ball of a micrometre", "its cone is 1e-12 of the sphere", "a lamp of pi r² L", _tiny_ball),
    HardCase(
        "ball that touches the floor",
        "its cone reaches the horizon",
        "pi L (r / d)² cos within six standard errors",
        _touching_ball,
    ),
    HardCase(
        "ball around everything",
        "the inside of a lamp is no part of the scene",
        "refused",
        _ball_around_everything,
        REFUSED,
    ),
    HardCase("sun along a wall", "cosine 0 of rounded vectors", "at most the rounding of a cosine", _grazing_sun),
    HardCase("doubled walls", "coplanar, cut another way: rays hit either", "as the single wall", lambda: even(split_again(5))),
    HardCase(
        "sheet without thickness",
        "front and back in one plane: rays hit either",
        "as the front alone",
        lambda: even(split_again(5, opposed=True)),
    ),
    HardCase(
        "repeated triangles",
        "every other wall stands twice",
        "removed, said, equal bits",
        lambda: cleaned(room().corners[::2], "repeated triangles removed"),
    ),
    HardCase(
        "backs of triangles",
        "a sheet of two sides made of one set of corners",
        "removed, said, equal bits",
        lambda: cleaned(room().corners[::2, ::-1], "the back of another"),
    ),
    HardCase(
        "triangles of no area",
        "points and lines",
        "removed, said, equal bits",
        lambda: cleaned(
            np.array([[[0.5] * 3] * 3, [[0.1, 0.1, 0.1], [0.9, 0.9, 0.9], [0.5, 0.5, 0.5]]]), "triangles of no area removed"
        ),
    ),
    HardCase("slivers", "needles two hundred times as long as wide", "the light of a plain room", _slivers),
    HardCase("texels of no area", "a crumb of 1e-8 m²", "nothing divides by it", _texels_of_no_area),
    HardCase(
        "points inside walls",
        "nothing is measured",
        "a black model that says so",
        _points_inside,
        BLACK,
    ),
    HardCase(
        "hull of a room",
        "the hull looks outwards",
        "a black model that says so",
        _hull_of_a_room,
        BLACK,
    ),
    HardCase("lamp that no point sees", "texels are lit, the column is 0", "relit as exactly nothing", _seen_by_no_point, ANY),
    HardCase(
        "points at one place", "supersamples go to the nearest point", "each measures the same light", _points_at_one_place, ANY
    ),
    *(
        HardCase(
            f"{what} in a lighting",
            "JSON of Python says NaN and Infinity",
            "refused",
            lambda v=value: in_json(point(0, 0, 0, v, 1, 1), "intensity"),
            REFUSED,
        )
        for what, value in (("NaN", np.nan), ("infinity", np.inf), ("a negative", -1.0))
    ),
    *(
        HardCase(
            f"{what} in a {kind} file",
            "another program wrote the dataset",
            "refused",
            lambda k=kind, v=value, w=what: spoilt(k, v, w),
            REFUSED,
        )
        for kind, what, value in (
            ("indirect", "NaN", np.nan),
            ("indirect", "infinity", np.inf),
            ("indirect", "negative", -1.0),
            ("measured", "NaN", np.nan),
            ("measured", "negative", -1.0),
            ("area", "NaN", np.nan),
        )
    ),
    HardCase("exposure of 4000", "a header that makes infinity of light", "refused", _bad_exposure, REFUSED),
)
