"""How low-dimensional is indirect light, and how does error fall with the number of bases? The paper's Figures 3, 13 and 14.

Question: on the scenes that there are, in linear and gamma space, mono and multi channel: how fast do eigenvalues fall, how far
          is the transfer from the projection, and what do 4, 16 and 64 bases look like?
Command:  python experiments/paper_figures.py            minutes; writes docs/paper-eigenvalues.png, -bases.png, -pictures.png
          python experiments/paper_figures.py --quick    small and noisy, pictures into runs/paper-quick
Answer:   docs/paper.md; what more measurement points buy is asked by bases_and_points.py

Three ways to fit, each with all four encodings:
  ours      no centring, area weights, ridge by leave-one-out
  paper     mean taken from both sides, texel weights, ridge 1e-3 (its Figure 14); n bases are the mean and n - 1 vectors
  as read   the same with the mean taken from the indirect light alone, as its section 4.2 reads

Two errors. The paper calls its own "average RMSE" and gives no unit. Here that is the RMSE over texels and channels of each
lighting (every texel counts alike), in units of the RMS of that lighting's measured direct light, averaged over lightings: the
paper divides by the norm of the direct vector, and the RMS is that norm without the number of points in it. Ours is the
relative RMSE (`ddprt.report.metrics`): area-weighted, pooled over lightings, over the mean of the reference.
"""

import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

import ddprt
from ddprt.config import Config, load_config
from ddprt.dataset.store import Dataset
from ddprt.fitting.basis import entry_weights
from ddprt.fitting.transfer import fit_transfer
from ddprt.methods.method import columns, measured
from ddprt.report.metrics import Truth
from ddprt.report.view import default_camera, diverging, exposure_for, signed_range, take_view, tonemap
from ddprt.runtime.model import Model
from ddprt.runtime.train import examples
from ddprt.sections import FitConfig
from ddprt.transport.embree import Tracer

BASES, SHOWN, POINTS, RIDGE = (4, 8, 16, 32, 64), (4, 16, 64), 256, 1e-3
UPPER: dict[str, str] = {}  # lamps as in configs/cornell.toml: the upper part of the room
SCENES = {
    "cornell": UPPER,
    "cornell-hole": UPPER,
    "corridor": {"lightings.clearance": "0.2"},
    # Spots about one asset: what the paper lights its Viking by.
    "statue": {"lightings.distribution": "around", "lightings.kinds": "['spot']"},
}
ENCODINGS = {
    "linear mono": {"space": "linear", "channels": "mono"},
    "linear multi": {"space": "linear", "channels": "multi"},
    "gamma mono": {"space": "gamma", "channels": "mono"},
    "gamma multi": {"space": "gamma", "channels": "multi"},
}
WAYS = ("ours", "paper", "as read")
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7")  # told apart by colour-blind eyes (Okabe and Ito)
MARKS = "osD^"
FULL = {"atlas.resolution": "128", "transport.target_noise": "0.005", "points.count": str(POINTS)}
QUICK = {"atlas.resolution": "40", "lightings.train": "72", "lightings.test": "8", "lightings.validation": "1"}
QUICK |= {"transport.samples": "256", "transport.test_samples": "256", "transport.direct_samples": "1"}
QUICK |= {"points.count": "64", "points.supersample": "4"}


@dataclass(frozen=True, eq=False)
class Held:
    """The held-out lightings of a scene: references, what the points measure, and the unit of the paper's error."""

    truth: Truth
    values: np.ndarray
    unit: np.ndarray  # RMS of the measured direct light of each lighting, W/m²

    @classmethod
    def of(cls, data: Dataset, points: int) -> "Held":
        test = data.split("test")
        values = data.values(test, points, "radiosity")
        unit = np.sqrt(np.mean(values.astype(np.float64) ** 2, (1, 2)))
        return cls(Truth(data.maps("indirect", test), data.area), values, unit)

    def errors(self, light: np.ndarray) -> tuple[float, float]:
        """The paper's error and ours; lightings that no point sees count in ours alone."""
        difference = light - self.truth.reference
        return average_rmse(difference, self.unit), float(self.truth.relative_rmse(difference) or 0.0)


def average_rmse(difference: np.ndarray, unit: np.ndarray) -> float:
    """Mean over lightings of the RMSE over texels and channels, each in its own unit; those of unit 0 are left out."""
    rmse = np.sqrt(np.mean(difference.astype(np.float64) ** 2, (1, 2)))
    return float(np.mean(rmse[unit > 0] / unit[unit > 0]))


def fit(data: Dataset, way: str, encoding: dict[str, str], bases: int = max(BASES)) -> Model:
    points = data.description["points"]["count"]
    if way == "ours":
        return ddprt.fit(data, bases=bases, points=points, **encoding)
    model = ddprt.fit(data, bases=bases, points=points, centre="mean", weights="texel", ridge=RIDGE, **encoding)
    return model if way == "paper" else as_it_reads(data, model)


def as_it_reads(data: Dataset, model: Model) -> Model:
    """M from measurements that keep their mean to coefficients that lost theirs, and no intercept to make up for it."""
    config = FitConfig(weights="texel", channels=model.encoding.channels)
    train = examples(data, "train", model.encoding, config, model.points, model.quantity)
    relighter: Any = model.relighter
    rows, _ = columns(train)
    weights = jnp.asarray(entry_weights(data.area, "texel", model.encoding.channels))
    coefficients = ((rows - relighter.mean) * weights) @ relighter.basis.T
    # Rows are the lit lightings of one channel after the other's lit ones, interleaved: lighting first, then channel.
    groups = len(relighter.matrix)
    placed = np.zeros((len(train.scale) * groups, coefficients.shape[1]), np.float32)
    placed[np.flatnonzero(np.asarray(train.scale[:, :groups]).reshape(-1) > 0)] = coefficients
    placed = placed.reshape(-1, groups, coefficients.shape[1])
    matrix = np.array(relighter.matrix)
    for part in measured(train):
        found = fit_transfer(part.values, jnp.asarray(placed[part.rows, part.group]), ridge=RIDGE)
        matrix[part.group] = found.matrix
    nothing = {"offset": jnp.zeros_like(relighter.offset), "intercept": jnp.zeros_like(relighter.intercept)}
    return replace(model, relighter=replace(relighter, matrix=jnp.asarray(matrix), **nothing))


def shortened(model: Model, bases: int) -> Model | None:
    """The same model with `bases` bases, the mean counted in; None where it has fewer."""
    relighter: Any = model.relighter
    has_mean = relighter.report.bases - len(relighter.basis)
    return replace(model, relighter=relighter.truncated(bases - has_mean)) if bases <= relighter.report.bases else None


def projected(model: Model, held: Held, area: np.ndarray) -> np.ndarray:
    """References encoded, projected on the model's basis in the weights that it was made for, decoded and clamped."""
    relighter: Any = model.relighter
    encoding, reference = model.encoding, held.truth.reference
    scale = encoding.scale(jnp.asarray(held.values))
    encoded = encoding.encode(jnp.asarray(reference), scale)
    mono = encoding.channels == "mono"
    rows = jnp.moveaxis(encoded, 2, 1) if mono else encoded.reshape(len(encoded), 1, -1)
    kind = "texel" if np.any(np.asarray(relighter.mean)) else "area"
    weights = jnp.asarray(entry_weights(area, kind, encoding.channels))
    light = (
        jnp.matmul((rows - relighter.mean) * weights, relighter.basis.T, precision="highest") @ relighter.basis + relighter.mean
    )
    back = jnp.moveaxis(light, 1, 2) if mono else light.reshape(encoded.shape)
    return np.asarray(encoding.decode(back, scale))


def curve(data: Dataset, model: Model, held: Held) -> list[tuple[int, tuple[float, float], tuple[float, float]]]:
    """Rows of bases, errors of the transfer and errors of the projection, each in the paper's metric and in ours."""
    rows = []
    for bases in BASES:
        if short := shortened(model, bases):
            light = short.predict(held.values)
            rows.append((bases, held.errors(light), held.errors(projected(short, held, data.area))))
    return rows


def eigenvalues(model: Model) -> np.ndarray:
    """Of the autocorrelation matrix of the training maps, over the largest, falling."""
    relighter: Any = model.relighter
    squares = np.asarray(relighter.report.singular_values, np.float64) ** 2
    return squares / squares[0]


def settings(name: str, quick: bool) -> Config:
    return load_config("configs/cornell.toml", {**FULL, **(QUICK if quick else {}), **SCENES[name]})


def main(quick: bool) -> None:
    folder = Path("runs/paper-quick" if quick else "docs")
    folder.mkdir(parents=True, exist_ok=True)
    spectra: dict[tuple[str, str, str], np.ndarray] = {}
    curves: dict[tuple[str, str, str], list[Any]] = {}
    pictures, floors = {}, {}
    for name in ("cornell", "statue") if quick else SCENES:
        config = settings(name, quick)
        data = ddprt.bake(ddprt.load_scene(name), config=config, out=Path("runs") / f"paper-{name}{'-quick' if quick else ''}")
        held = Held.of(data, config.points.count)
        noise = data.maps("noise", data.split("test"))
        floors[name] = average_rmse(noise, held.unit), float(held.truth.relative_rmse(noise) or 0.0)
        print(
            f"\n{name}: {int(data.covered.sum())} texels, {len(data.split('train'))} + {len(held.values)} lightings, ", end=""
        )
        print(f"{config.points.count} points; noise floor {floors[name][0]:.5f} (paper's), {floors[name][1]:.4f} (ours)")
        print("| fit | encoding | error | " + " | ".join(f"{bases} bases" for bases in BASES) + " |")
        print("| --- " * (3 + len(BASES)) + "|")
        for way in WAYS:
            for label, encoding in ENCODINGS.items():
                if quick and way != "ours" and label != "linear mono":
                    continue
                model = fit(data, way, encoding)
                if way != "as read":
                    spectra[name, way, label] = eigenvalues(model)
                rows = curves[name, way, label] = curve(data, model, held)
                for which, metric in enumerate(("paper's", "ours")):
                    cells = [f"{transfer[which]:.4f} / {floor[which]:.4f}" for _, transfer, floor in rows]
                    print(f"| {way} | {label} | {metric} | " + " | ".join(cells) + " |", flush=True)
                if way == "ours" and label == "linear mono":
                    pictures[name] = rendered(data, model, held)
    print(
        "\neigenvalues of at least 1 % of the largest; of at least 1 % of their sum; how many hold 99 % and 99.99 % of the sum"
    )
    for (name, way, label), values in spectra.items():
        print(
            f"| {name} | {'none' if way == 'ours' else 'mean'} | {label} | " + " | ".join(map(str, dimensions(values))) + " |"
        )
    draw_eigenvalues(spectra, folder / "paper-eigenvalues.png")
    draw_bases(curves, floors, folder / "paper-bases.png")
    draw_pictures(pictures, folder / "paper-pictures.png")


def dimensions(values: np.ndarray) -> tuple[int, int, int, int]:
    """Eigenvalues of at least 1 % of the first and of the sum; how many of the largest hold 99 % and 99.99 % of the sum."""
    share = np.cumsum(values) / values.sum()
    first, whole = (int(np.sum(values >= 0.01 * unit)) for unit in (values[0], values.sum()))
    return first, whole, *(int(np.searchsorted(share, part) + 1) for part in (0.99, 0.9999))


def rendered(data: Dataset, model: Model, held: Held) -> tuple[list[np.ndarray], list[str]]:
    """A row of Figure 13: the held-out lighting of median error at 16 bases, indirect light alone, albedo multiplied in."""
    shorts = [(bases, short) for bases in SHOWN if (short := shortened(model, bases))]
    lights = {bases: short.predict(held.values) for bases, short in shorts}
    errors = {bases: held.truth.errors_per_lighting(light) for bases, light in lights.items()}
    order = np.argsort(errors[16])
    chosen = order[len(order) // 2]
    scene = ddprt.load_scene(model.scene["name"])
    view = take_view(Tracer.of(scene), data.uv, data.covered, default_camera(scene), 220)
    albedo, reference = data.gbuffer["albedo"], held.truth.reference[chosen]
    # Open fronts and ground that hardly sees anything are dark; exposure follows what is seen.
    seen = view.render(albedo * reference)
    stops = exposure_for(seen[view.alpha > 0])
    shown = {bases: view.render(albedo * light[chosen]) for bases, light in lights.items()}
    limit = signed_range(shown[min(shown)] - seen)
    images = [*(tonemap(image, stops) for image in shown.values()), tonemap(seen, stops)]
    images += [diverging((image - seen).mean(2), limit) for image in shown.values()]
    titles = [f"{bases} bases, {errors[bases][chosen]:.1%} off" for bases in shown]
    scale = f"±{limit:.2g} W/m²"
    return [np.where(view.alpha[..., None] > 0, image, 1) for image in images], [
        *titles, "reference", *(f"{bases}: difference {scale}" for bases in shown)
    ]  # fmt: skip


def draw_eigenvalues(spectra: dict[tuple[str, str, str], np.ndarray], out: Path) -> None:
    import matplotlib.pyplot as plt

    figure, panels = plt.subplots(2, 4, figsize=(14, 6.4), layout="constrained", sharex=True, sharey=True)
    for row, (way, centred) in zip(panels, (("ours", "uncentred"), ("paper", "mean taken out")), strict=True):
        for axes, label in zip(row, ENCODINGS, strict=True):
            for name, colour, mark in zip(SCENES, COLOURS, MARKS, strict=True):
                if (name, way, label) not in spectra:
                    continue
                values = spectra[name, way, label][:64]
                axes.semilogy(np.arange(1, len(values) + 1), values, mark + "-", color=colour, label=name, ms=3, lw=1)
            axes.axhline(0.01, color="#222222", linestyle="--", linewidth=0.8)
            axes.text(64, 0.012, "1 %", ha="right", fontsize=8)
            axes.set_title(f"{label}, {centred}", fontsize=9)
            axes.grid(alpha=0.3)
        row[0].set_ylabel("eigenvalue over the largest")
    for axes in panels[1]:
        axes.set_xlabel("index")
    panels[0, 0].legend(fontsize=8)
    figure.savefig(out, dpi=90)
    print(out)


def draw_bases(curves: dict[tuple[str, str, str], list[Any]], floors: dict[str, tuple[float, float]], out: Path) -> None:
    """Above: scenes against each other. Below: encodings on each scene, in our fit and our metric."""
    import matplotlib.pyplot as plt
    from matplotlib.lines import Line2D

    def plot(axes: Any, rows: list[Any], which: int, colour: str, mark: str, label: str) -> None:
        bases = [row[0] for row in rows]
        axes.loglog(bases, [row[1][which] for row in rows], mark + "-", color=colour, label=label, ms=4)
        axes.loglog(bases, [row[2][which] for row in rows], mark + "--", color=colour, ms=4, mfc="white", lw=1)

    figure, panels = plt.subplots(2, 4, figsize=(15, 7.2), layout="constrained")
    shown = (("paper", 0, "paper's fit, paper's error"), ("as read", 0, "paper's fit as it reads, paper's error"))
    shown += (("ours", 0, "our fit, paper's error"), ("ours", 1, "our fit, our error"))
    for axes, (way, which, title) in zip(panels[0], shown, strict=True):
        for name, colour, mark in zip(SCENES, COLOURS, MARKS, strict=True):
            if name in floors:
                plot(axes, curves[name, way, "linear mono"], which, colour, mark, name)
        axes.set_title(f"{title}\n(linear, mono)", fontsize=9)
        axes.set_ylabel(("average RMSE over RMS direct light", "relative RMSE")[which])
    for axes, name in zip(panels[1], floors, strict=False):
        for label, colour, mark in zip(ENCODINGS, COLOURS, MARKS, strict=True):
            plot(axes, curves[name, "ours", label], 1, colour, mark, label)
        axes.axhline(floors[name][1], color="grey", linestyle=":", linewidth=1)
        axes.set_title(f"{name}: encodings, our fit, our error", fontsize=9)
        axes.set(ylabel="relative RMSE", xlabel="bases")
    for axes in panels.flat:
        axes.set_xticks(BASES, [str(bases) for bases in BASES])
        axes.set_xticks([], minor=True)
        axes.grid(alpha=0.3, which="both")
    for row in panels:
        low = min(axes.get_ylim()[0] for axes in row if axes.lines)
        high = max(axes.get_ylim()[1] for axes in row if axes.lines)
        for axes in row:
            axes.set_ylim(low, high)
    styles = [Line2D([], [], color="#222222", label="transfer")]
    styles += [Line2D([], [], color="#222222", linestyle="--", marker="o", mfc="white", ms=4, label="projection")]
    for axes, last in ((panels[0, 0], []), (panels[1, 0], [Line2D([], [], color="grey", linestyle=":", label="noise floor")])):
        axes.legend(handles=[*axes.get_legend_handles_labels()[0], *styles, *last], fontsize=8)
    figure.savefig(out, dpi=90)
    print(out)


def draw_pictures(pictures: dict[str, tuple[list[np.ndarray], list[str]]], out: Path) -> None:
    import matplotlib.pyplot as plt

    wide = max(len(images) for images, _ in pictures.values())
    figure, panels = plt.subplots(len(pictures), wide, figsize=(2.1 * wide, 2.1 * len(pictures)), layout="constrained")
    for row, (name, (images, titles)) in zip(panels, pictures.items(), strict=True):
        for axes in row:
            axes.axis("off")
        for axes, image, title in zip(row, images, titles, strict=False):
            axes.imshow(image)
            axes.set_title(title, fontsize=7.5)
        row[0].text(-0.04, 0.5, name, rotation=90, ha="right", va="center", fontsize=9, transform=row[0].transAxes)
    figure.savefig(out, dpi=100)
    print(out)


if __name__ == "__main__":
    import matplotlib

    matplotlib.use("Agg")
    main("--quick" in sys.argv[1:])
