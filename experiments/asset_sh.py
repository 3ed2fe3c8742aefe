"""An asset under suns and skies: how much light leaks behind it by classical PRT, and by ours with as many numbers?

Question: light told by harmonics is blurred before it meets the asset, so that a sun reaches behind it (the paper's section 6.4
          and Figure 12). How much at which order, what does svd-ridge make of (order + 1)² bases, and how is it under a sky?
Command:  python experiments/asset_sh.py [folder of a run]   (after `ddprt run configs/asset.toml`; --quick bakes its own)
          python experiments/asset_sh.py sky [folder of a dataset]   (bakes it there if it is not; --quick a small one)
Figure:   docs/asset-sh.png, docs/asset-sky.png
Answer:   docs/paper.md, "Classical PRT"

Behind the asset are the texels where the reference, direct and indirect light together, stays below 1 % of the brightest direct
light of the lighting, in luminance. The leak of a method is the share of its indirect light, clamped at 0 as an engine does,
that lands there, over all held-out lightings; what the reference itself has there stands beside it.

Under a sky hardly a texel is that dark. There, behind is the third of the surface where the reference is darkest: about what a
lone sun leaves dark. The sky is `sun-sky`, which has a sun of its own, turned at random; lightings are one or two suns, one or
two skies, or one of each, and all three kinds are learned together.
"""

import json
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import ddprt
from ddprt.config import load_config
from ddprt.dataset.store import Dataset
from ddprt.methods.sh_prt import describe
from ddprt.report.drawing import INK, blank, saved, style
from ddprt.report.metrics import Truth
from ddprt.report.view import LUMINANCE, Camera, exposure_for, take_view, tonemap
from ddprt.runtime.model import Model
from ddprt.scene.mesh import Scene
from ddprt.transport.embree import Tracer

DARK, SHADE = 0.01, 1 / 3
ORDERS = (1, 2, 3, 4, 5, 6)
SKIES = {
    "lightings.kinds": '["directional", "environment"]',
    "lightings.lights": "[1, 2]",
    "lightings.environment": "sun-sky",
    "lightings.test": "48",
    "transport.direct_samples": "64",
}
GROUPS = {"suns": {"directional"}, "skies": {"environment"}, "sun and sky": {"directional", "environment"}}
UNDER_SKIES = (("svd-ridge", 16), ("svd-ridge", 49), ("svd-ridge", 64), ("sh-prt", 9), ("sh-prt", 25), ("sh-prt", 49))
KINDS = {
    "svd-ridge": "svd-ridge, as many bases",
    "sh-prt": "harmonics, ridge by leave-one-out",
    "least squares": "harmonics, no ridge",
    "hanning": "harmonics, no ridge, Hanning window",
}


@dataclass
class Row:
    """What one method did with (order + 1)² numbers."""

    kind: str
    order: int
    leak: float
    error: float
    median: float


class Asset:
    """Held-out lightings of a baked asset.

    Args:
      data: the asset's.
      test: of its rows; all that are held out unless given.
      shade: behind is this share of the surface; unless given, what is nearly dark.
    """

    def __init__(self, data: Dataset, test: list[int] | None = None, shade: float = 0.0) -> None:
        self.data, self.test = data, data.split("test") if test is None else test
        self.truth = Truth(data.maps("indirect", self.test), data.area)
        self.direct = data.maps("direct", self.test)
        direct, whole = self.direct @ LUMINANCE, (self.direct + self.truth.reference) @ LUMINANCE
        self.behind = darkest(whole, data.area, shade) if shade else whole < DARK * direct.max(1, keepdims=True)
        self.lightings = [data.lightings[index] for index in self.test]

    def leak(self, light: np.ndarray) -> float:
        """Share of indirect light that lands behind the asset."""
        bright = np.maximum(light, 0) @ LUMINANCE * self.data.area
        return float((bright * self.behind).sum() / bright.sum())

    def excess(self, light: np.ndarray) -> float:
        """Indirect light behind the asset, as a multiple of what the reference has there."""
        there = [(np.maximum(one, 0) @ LUMINANCE * self.data.area * self.behind).sum() for one in (light, self.truth.reference)]
        return float(there[0] / there[1])

    def fitted(self, kind: str, order: int) -> Model:
        if kind == "svd-ridge":
            return ddprt.fit(self.data, bases=(order + 1) ** 2)
        window = "hanning" if kind == "hanning" else "none"
        ridge = "auto" if kind == "sh-prt" else 0.0
        return ddprt.fit(self.data, "sh-prt", ridge=ridge, settings={"order": order, "window": window})

    def light(self, model: Model) -> np.ndarray:
        values = self.data.values(self.test, model.points, model.quantity)
        return model.predict(values, lightings=self.lightings)

    def row(self, kind: str, order: int) -> Row:
        light = self.light(self.fitted(kind, order))
        each = self.truth.errors_per_lighting(light)
        return Row(
            kind, order, self.leak(light), self.truth.relative_rmse(light - self.truth.reference), float(np.median(each))
        )


def darkest(light: np.ndarray, area: np.ndarray, share: float) -> np.ndarray:
    """Of each lighting the texels with the least light that make up a share of the surface."""
    order = np.argsort(light, 1)
    found = np.zeros(light.shape, bool)
    np.put_along_axis(found, order, np.cumsum(area[order], 1) <= share * area.sum(), 1)
    return found


def main(*arguments: str) -> None:
    quick = "--quick" in arguments
    if "sky" in arguments:
        under_skies(quick, Path(next((one for one in arguments if one not in ("sky", "--quick")), "runs/asset-sky")))
        return
    folder = Path(next((one for one in arguments if one != "--quick"), "runs/asset"))
    data, scene = small() if quick else (ddprt.open_dataset(folder / "dataset"), ddprt.load_scene("lion"))
    asset = Asset(data)
    own = asset.leak(asset.truth.reference)
    print(f"{asset.behind.mean():.1%} of texels are behind; the reference has {own:.2%} of its indirect light there")
    print(f"{'':36}{'order':>6}{'numbers':>8}{'leak':>8}{'error':>8}{'median':>8}")
    rows = []
    for kind in KINDS:
        for order in (2, 4) if quick else ORDERS:
            rows.append(asset.row(kind, order))
            one = rows[-1]
            print(f"{KINDS[kind]:36}{order:6}{(order + 1) ** 2:8}{one.leak:8.2%}{one.error:8.3f}{one.median:8.3f}", flush=True)
    if quick:
        print(json.dumps({"reference_leak": own, "rows": [vars(row) for row in rows]}))
    else:
        draw(asset, scene, rows, Path("docs/asset-sh.png"))


def under_skies(quick: bool, folder: Path) -> None:
    """Leak and error by kind of lighting, for as many numbers as an engine might spend."""
    if quick:
        data, scene = small(SKIES)
    else:
        scene = ddprt.load_scene("lion")
        data = ddprt.bake(scene, config=load_config("configs/asset.toml", SKIES), out=folder)
    kinds = {index: {light.kind for light in data.lightings[index]} for index in data.split("test")}
    groups = {name: Asset(data, [at for at, kind in kinds.items() if kind == wanted], SHADE) for name, wanted in GROUPS.items()}
    rows: dict[str, dict[str, dict[str, float]]] = {}
    for name, asset in groups.items():
        own = asset.leak(asset.truth.reference)
        print(f"{name}: {len(asset.test)} held out; the reference has {own:.2%} of its indirect light in the dark third")
        rows[name] = {"reference": {"leak": own}}
    for kind, numbers in UNDER_SKIES:
        model = under_skies_model(data, kind, numbers)
        for name, asset in groups.items():
            light = asset.light(model)
            error = asset.truth.relative_rmse(light - asset.truth.reference)
            found = {"leak": asset.leak(light), "excess": asset.excess(light), "error": error}
            rows[name][f"{kind}, {numbers}"] = found
            print(
                f"{kind:10}{numbers:4} {name:12} leak {found['leak']:7.2%} times {found['excess']:.3f} error {error:.3f}",
                flush=True,
            )
    if quick:
        print(json.dumps(rows))
        return
    asset = groups["skies"]
    models = {
        f"svd-ridge, {numbers} bases" if kind == "svd-ridge" else f"harmonics, order {round(numbers**0.5) - 1}": asset.light(
            under_skies_model(data, kind, numbers)
        )
        for kind, numbers in (("svd-ridge", 49), ("sh-prt", 49), ("sh-prt", 9))
    }
    with style():
        figure = blank(11.5, 2.9)
        shown = picture(asset, scene, models, figure)
    path = Path("docs/asset-sky.png")
    path.write_bytes(saved(figure, "png", dpi=100, facecolor="white"))
    print(path, f"lighting {asset.test[shown]}")


def under_skies_model(data: Dataset, kind: str, numbers: int) -> Model:
    if kind == "svd-ridge":
        return ddprt.fit(data, bases=numbers)
    return ddprt.fit(data, "sh-prt", settings={"order": round(numbers**0.5) - 1})


def small(changes: dict[str, str] | None = None) -> tuple[Dataset, Scene]:
    """An asset of few texels, for a look in seconds."""
    settings = {"atlas.resolution": "64", "lightings.train": "128", "lightings.validation": "4"}
    rays = {"transport.samples": "256", "transport.test_samples": "512", "points.count": "96", "points.supersample": "4"}
    scene = ddprt.load_scene("lion")
    changes = {**settings, **rays, **(changes or {}), "lightings.test": "12"}
    return ddprt.bake(scene, config=load_config("configs/asset.toml", changes)), scene


def picture(asset: Asset, scene: Scene, lights: dict[str, np.ndarray], figure: Any) -> int:
    """One held-out lighting, the median in leak by harmonics of order 6, seen from the side that it leaves dark."""
    most = lights["harmonics, order 6"].clip(0) @ LUMINANCE * asset.behind @ asset.data.area
    shown = int(np.argsort(most / (asset.truth.reference @ LUMINANCE @ asset.data.area))[len(most) // 2])
    _, z, x = describe([asset.lightings[shown]], 1)[0, 1:] @ LUMINANCE  # where its light comes from
    middle, reach = scene.centre, scene.radius
    away = -np.array([x, 0.0, z])
    away = away / max(float(np.linalg.norm(away)), 1e-9) + [0.0, 0.35, 0.0]
    eye = middle + 2.9 * reach * away / np.linalg.norm(away)
    view = take_view(Tracer.of(scene), asset.data.uv, asset.data.covered, Camera(tuple(eye), tuple(middle), aspect=1.0), 420)
    reference, albedo = asset.truth.reference[shown], asset.data.gbuffer["albedo"]
    stops = exposure_for(reference)
    pictures = {"direct": asset.direct[shown], "reference": reference}
    pictures |= {name: light[shown] for name, light in lights.items()}
    for place, (name, light) in zip(figure.subplots(1, 5), pictures.items(), strict=True):
        image = tonemap(view.render(albedo * light), stops if name == "direct" else stops + 1)
        place.imshow(1 - view.alpha[..., None] * (1 - image.clip(0, 1)), interpolation="none")
        place.set_title(name if name == "direct" else f"{name}, indirect")
        place.axis("off")
    return shown


def draw(asset: Asset, scene: Scene, rows: list[Row], path: Path) -> None:
    """One held-out sun, seen from the side that it leaves dark, and the leak and error of all."""
    models = {"svd-ridge, 49 bases": asset.fitted("svd-ridge", 6)}
    models |= {f"harmonics, order {order}": asset.fitted("least squares", order) for order in (6, 2)}
    lights = {name: asset.light(model) for name, model in models.items()}
    with style():
        figure = blank(11.5, 6.2)
        upper, lower = figure.subfigures(2, 1, height_ratios=[1, 1.1])
        shown = picture(asset, scene, lights, upper)
        leak, error = lower.subplots(1, 2)
        drawn = [kind for kind in KINDS if kind != "sh-prt"]  # its ridges are 0 or nearly so: the same curve as without
        for colour, kind in zip(("#0969da", "#bc4c00", "#8250df"), drawn, strict=True):
            some = [row for row in rows if row.kind == kind]
            numbers = [(row.order + 1) ** 2 for row in some]
            leak.plot(numbers, [100 * row.leak for row in some], "o-", color=colour, label=KINDS[kind])
            error.plot(numbers, [row.error for row in some], "o-", color=colour)
        leak.axhline(100 * asset.leak(asset.truth.reference), color=INK["muted"], linestyle=":", label="reference")
        leak.set(xlabel="bases, or harmonics", ylabel="% of indirect light behind the asset", ylim=(0, None))
        error.set(xlabel="bases, or harmonics", ylabel="relative RMSE, held out", ylim=(0, None))
        leak.legend(frameon=False)
    path.write_bytes(saved(figure, "png", dpi=100, facecolor="white"))
    print(path, f"sun {asset.test[shown]}")


if __name__ == "__main__":
    main(*sys.argv[1:])
