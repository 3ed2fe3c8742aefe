"""An asset under a sun: how much light leaks behind it by classical PRT, and by ours with as many numbers?

Question: light told by harmonics is blurred before it meets the asset, so that a sun reaches behind it (the paper's section 6.4
          and Figure 12). How much at which order, and what does svd-ridge make of (order + 1)² bases?
Command:  python experiments/asset_sh.py [folder of a run]   (after `ddprt run configs/asset.toml`; --quick bakes its own)
Figure:   docs/asset-sh.png
Answer:   docs/paper.md, "Classical PRT"

Behind the asset are the texels where the reference, direct and indirect light together, stays below 1 % of the brightest direct
light of the lighting, in luminance. The leak of a method is the share of its indirect light, clamped at 0 as an engine does,
that lands there, over all held-out lightings; what the reference itself has there stands beside it.
"""

import json
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np

import ddprt
from ddprt.config import load_config
from ddprt.dataset.store import Dataset
from ddprt.report.drawing import INK, blank, saved, style
from ddprt.report.metrics import Truth
from ddprt.report.view import LUMINANCE, Camera, exposure_for, take_view, tonemap
from ddprt.runtime.model import Model
from ddprt.scene.mesh import Scene
from ddprt.transport.embree import Tracer

DARK = 0.01
ORDERS = (1, 2, 3, 4, 5, 6)
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
    """Held-out lightings of a baked asset."""

    def __init__(self, data: Dataset) -> None:
        self.data, self.test = data, data.split("test")
        self.truth = Truth(data.maps("indirect", self.test), data.area)
        self.direct = data.maps("direct", self.test)
        direct, whole = self.direct @ LUMINANCE, (self.direct + self.truth.reference) @ LUMINANCE
        self.behind = whole < DARK * direct.max(1, keepdims=True)
        self.lightings = [data.lightings[index] for index in self.test]

    def leak(self, light: np.ndarray) -> float:
        """Share of indirect light that lands behind the asset."""
        bright = np.maximum(light, 0) @ LUMINANCE * self.data.area
        return float((bright * self.behind).sum() / bright.sum())

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


def main(*arguments: str) -> None:
    quick = "--quick" in arguments
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


def small() -> tuple[Dataset, Scene]:
    """An asset of few texels, for a look in seconds."""
    settings = {"atlas.resolution": "64", "lightings.train": "128", "lightings.validation": "4", "lightings.test": "12"}
    rays = {"transport.samples": "256", "transport.test_samples": "512", "points.count": "96", "points.supersample": "4"}
    scene = ddprt.load_scene("lion")
    return ddprt.bake(scene, config=load_config("configs/asset.toml", settings | rays)), scene


def draw(asset: Asset, scene: Scene, rows: list[Row], path: Path) -> None:
    """One held-out sun, seen from the side that it leaves dark, and the leak and error of all."""
    models = {"svd-ridge, 49 bases": asset.fitted("svd-ridge", 6)}
    models |= {f"harmonics, order {order}": asset.fitted("least squares", order) for order in (6, 2)}
    lights = {name: asset.light(model) for name, model in models.items()}
    most = lights["harmonics, order 6"].clip(0) @ LUMINANCE * asset.behind @ asset.data.area
    shown = int(np.argsort(most / (asset.truth.reference @ LUMINANCE @ asset.data.area))[len(most) // 2])  # the median
    travel = np.array(asset.lightings[shown][0].direction)
    middle, reach = scene.centre, scene.radius
    away = np.array([travel[0], 0.0, travel[2]])
    away = away / max(float(np.linalg.norm(away)), 1e-9) + [0.0, 0.35, 0.0]
    eye = middle + 2.9 * reach * away / np.linalg.norm(away)
    view = take_view(Tracer.of(scene), asset.data.uv, asset.data.covered, Camera(tuple(eye), tuple(middle), aspect=1.0), 420)
    reference, albedo = asset.truth.reference[shown], asset.data.gbuffer["albedo"]
    stops = exposure_for(reference)
    pictures = {"direct": asset.direct[shown], "reference": reference}
    pictures |= {name: light[shown] for name, light in lights.items()}
    with style():
        figure = blank(11.5, 6.2)
        upper, lower = figure.subfigures(2, 1, height_ratios=[1, 1.1])
        for place, (name, light) in zip(upper.subplots(1, 5), pictures.items(), strict=True):
            image = tonemap(view.render(albedo * light), stops if name == "direct" else stops + 1)
            place.imshow(1 - view.alpha[..., None] * (1 - image.clip(0, 1)), interpolation="none")
            place.set_title(name if name == "direct" else f"{name}, indirect")
            place.axis("off")
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
    print(path, f"sun {asset.test[shown]}, travelling {np.round(travel, 2).tolist()}")


if __name__ == "__main__":
    main(*sys.argv[1:])
