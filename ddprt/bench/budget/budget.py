"""Where the error of relit light comes from: a nested chain of experiments, each with one more cause removed.

What ships, fed by an engine's shadow maps, stands at one end; unbiased light at the other. The steps, in order:

| step | from | to |
| --- | --- | --- |
| clamp | negative light cut off, as an engine does | negative light kept |
| runtime mismatch | measured by shadow maps | measured by shadow rays |
| quantisation | arrays as they are stored | arrays as they were fitted |
| noise | fitted on the run's maps | the same fit on maps next to free of noise, and on their basis |
| regularisation | that fit's transfer | the best on lightings in abundance |
| scenario shift | lightings as trained on | lightings as held out, as many |
| measurement | the transfer's coefficients | the best coefficients |
| operator bias | what the basis can show of the integrator's own maps | the same of unbiased paths |
| truncation | what the basis can show | all of the paths' light |

From quantisation to operator bias all fields lie in the span of the run's own basis. A residual of a projection is orthogonal
to that span, so truncation has no product with any of them. A residual of least squares is orthogonal, summed over the
lightings that it is fitted on, to all that is linear in the measurements: the best transfer is fitted on lightings that the
run has not seen, the held-out ones among them, so that measurement has none with regularisation and noise but by chance. Were
it fitted on other lightings than the held-out ones, its own luck d would stand on both sides with opposite sign, as -2
||d||², however many are held out.

What noise does to the basis is the square of what the run's basis leaves out less that of a basis of clean maps.
It lies within one step, and is told as noise: a difference of two squares by Pythagoras, which no product enters. So vectors at
the edge of a basis that change places cost what they cost, and not the light of either.

Bias stands behind all that is learned, which then happens in the integrator's own world, where maps next to free of noise cost
little; only held-out lightings need paths. What it does to the basis is in truncation, which is of true light.

Methods without a basis and a transfer have `the rest` in place of regularisation, measurement and truncation;
bias is of whole maps.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ddprt.axes import Float32, Float64
from ddprt.bench.budget.bakes import Bakery, Yardsticks
from ddprt.bench.budget.best_fit import best_transfer, projected, same_fit
from ddprt.bench.budget.chain import Link, Parts, take_apart
from ddprt.bench.budget.shadow_maps import engine_irradiance
from ddprt.dataset.store import average_into_points
from ddprt.errors import UserError
from ddprt.lights import Lighting
from ddprt.methods.svd_ridge import LinearTransfer
from ddprt.runtime.model import Model
from ddprt.runtime.precision import stored
from ddprt.runtime.train import fit_config
from ddprt.sections import BudgetConfig
from ddprt.transport.embree import Tracer

CAUSES = {
    "clamp": "negative light is cut off; its cross terms tell what that wins",
    "runtime mismatch": "an engine's shadow maps measure otherwise than shadow rays",
    "quantisation": "the basis is stored in few bits",
    "noise": "the maps learned from are noisy, or blurred against noise: what that does to the transfer, and to the basis",
    "regularisation": "few lightings, weighed alike, and a ridge in place of many",
    "scenario shift": "lightings are held out of another distribution than those trained on",
    "measurement": "the points do not tell all that the basis can show",
    "the rest": "what the method makes of clean maps: whatever it cannot learn, and what it learned from too few lightings",
    "operator bias": "the integrator's light differs from unbiased paths, as far as the basis can show it",
    "truncation": "the basis cannot show all there is",
}
"""Every part, in the order of the chain, and what it means."""


@dataclass(frozen=True, eq=False)
class Budget:
    """An error taken apart, and what it was done with.

    Attributes:
      parts: squares and products.
      yardsticks: the bakes.
      model: the one that it is of.
      clean: the model of the same fit on clean maps.
      truth: halves of the unbiased maps, W/m².
      own: halves of the integrator's held-out maps.
      values: measured light of the held-out lightings, W/m².
      weight: of the texels, summing to 1.
    """

    parts: Parts
    yardsticks: Yardsticks
    model: Model
    clean: Model
    truth: tuple[np.ndarray, np.ndarray]
    own: tuple[np.ndarray, np.ndarray]
    values: Float32[np.ndarray, "lightings points 3"]
    weight: Float64[np.ndarray, " texels"]

    @property
    def lightings(self) -> list[Lighting]:
        """The held-out ones."""
        data = self.yardsticks.clean
        return [data.lightings[index] for index in data.split("test")]

    @property
    def truth_noise(self) -> float:
        """Relative RMSE of the truth, which no part holds."""
        noise = (self.truth[0] - self.truth[1]).astype(np.float64) / 2
        return float(np.sqrt(np.einsum("ltc,t->", noise**2, self.weight) / (3 * len(noise))) / self.parts.mean)

    @property
    def chance(self) -> float:
        """The share of the squared total by which the truth's noise is expected to shift it, and cross terms with bias.

        Lightings share their paths, so that independent values are as many as texels: 2 ||e|| s / sqrt(texels) over ||e||².
        """
        return 2 * self.truth_noise / float(np.sqrt(len(self.weight) * max(self.parts.squared, 1e-30)))


def measure_budget(model: Model, bakery: Bakery) -> Budget:
    """Bakes what is needed and takes the error of a model apart.

    Args:
      model: fitted on the bakery's data as its configuration says.
      bakery: of the run.
    Raises:
      UserError: see `Bakery.yardsticks`; points that depend on more than the run's settings; or darkness.
    """
    config, progress = bakery.config, bakery.progress
    yard = bakery.yardsticks()
    for other in (yard.clean, yard.truth, *((yard.elsewhere,) if yard.elsewhere else ())):
        if other.samples.digest != bakery.data.samples.digest or not np.array_equal(other.covered, bakery.data.covered):
            raise UserError(
                f"{other.folder}: got other points or texels than the run's, expected the same; "
                "bake the run again with this version, and choose points by its settings alone"
            )
    clean = yard.clean
    test = clean.split("test")
    values = clean.values(test, model.points, model.quantity)
    with progress.stage("budget: shadow maps") as stage:
        engine, stage.facts["rays"] = engine_values(model, [clean.lightings[index] for index in test], config.budget)
    with progress.stage("budget: fits"):
        truth, own = yard.halves(yard.truth), yard.halves(clean)
        chain, clean_model = _chain(model, bakery, yard, engine, values)
        if isinstance(model.relighter, LinearTransfer):
            shown = [(projected(model, values, one), projected(model, values, other)) for one, other in (own, truth)]
            chain += [Link("operator bias", shown[0]), Link("truncation", shown[1]), Link("", truth)]
        else:
            chain += [Link("operator bias", own), Link("", truth)]
    with progress.stage("budget: parts"):
        weight = clean.area / clean.area.sum()
        parts = take_apart(chain, weight)
        if "truncation" in parts.causes:
            i = parts.causes.index("truncation")
            kept = projected(clean_model, values, truth[0]), projected(clean_model, values, truth[1])
            unavoidable = take_apart([Link("truncation", kept), Link("", truth)], weight).products[0, 0]
            parts = replace(parts, shared={("truncation", "noise"): float(parts.products[i, i] - unavoidable)})
    if not parts.mean > 0 or not parts.products.sum() > 0:
        raise UserError(
            "budget: got held-out lightings without indirect light or without error, expected some; check the lightings"
        )
    return Budget(parts, yard, model, clean_model, truth, own, values, weight)


def table(document: dict[str, Any]) -> str:
    """budget.json as text: parts, the largest cross terms, and advice."""
    rows = [f"{'part':<18}{'relative RMSE':>14}{'of the square':>15}"]
    rows += [f"{part['cause']:<18}{part['relative_rmse']:>14.3%}{part['share']:>15.1%}" for part in document["parts"]]
    crossed = sorted(document["cross_terms"], key=lambda pair: -abs(pair["share"]))
    rows.append(f"{'cross terms':<18}{'':>14}{1 - document['closure']:>15.1%}")
    rows += [f"  {' x '.join(pair['causes']):<30}{pair['share']:>15.1%}" for pair in crossed if abs(pair["share"]) >= 0.0005]
    rows.append(f"{'all':<18}{document['total']['relative_rmse']:>14.3%}{1:>15.1%}")
    rows.append(f"{'by chance':<18}{'':>14}{document['chance']:>15.1%}  of the truth's noise, {document['truth_noise']:.1%}")
    notes = [] if document["scenario"] else ["scenario shift is exactly 0: [budget] scenario is empty"]
    return "\n".join([*rows, *notes, document["advice"]])


def engine_values(model: Model, lightings: list[Lighting], budget: BudgetConfig) -> tuple[np.ndarray, int]:
    """(lightings, points, 3) light at a model's points by shadow maps, W/m², and the rays that drew them."""
    tracer, samples = Tracer(model.occluders, holes=model.holes, fog=model.fog), model.samples
    settings: dict[str, Any] = {"resolution": budget.shadow_map, "taps": budget.shadow_filter, "depth": samples.depth}
    rows = [engine_irradiance(tracer, lighting, samples.position, samples.normal, **settings) for lighting in lightings]
    return average_into_points(np.stack(rows), samples, model.points, model.quantity), tracer.rays


def _chain(
    model: Model,
    bakery: Bakery,
    yard: Yardsticks,
    engine: np.ndarray,
    values: np.ndarray,
) -> tuple[list[Link], Model]:
    """From what ships to what the integrator's own maps, which are left out, remove; and the model fitted on clean maps."""
    clean, config = yard.clean, bakery.config
    kept = stored(model, config.export.precision)
    unclamped = kept.predict(engine, clamp=False, constant=False)
    exact = kept.predict(values, clamp=False, constant=False)
    fitted = exact if kept is model else model.predict(values, clamp=False, constant=False)
    trained = yard.bounded(clean, yard.train)
    clean_model = fit_config(trained, config, model.method)
    chain = [
        Link.sure("clamp", np.maximum(unclamped, 0)),
        Link.sure("runtime mismatch", unclamped),
        Link.sure("quantisation", exact),
        Link.sure("noise", fitted),
    ]
    if isinstance(model.relighter, LinearTransfer):
        last = best_transfer(model, *yard.unseen())
        there = last if yard.elsewhere is None else best_transfer(model, (clean, clean.split("train")))
        there_light = there.predict(values, clamp=False, constant=False)
        chain += [
            Link.sure("regularisation", same_fit(model, trained, config).predict(values, clamp=False, constant=False)),
            Link.sure("scenario shift", there_light),
            Link.sure("measurement", there_light if last is there else last.predict(values, clamp=False, constant=False)),
        ]
    else:
        light = clean_model.predict(values, clamp=False, constant=False)
        last_light = light
        if yard.elsewhere is not None:
            last_light = fit_config(yard.bounded(yard.elsewhere, yard.train), config, model.method).predict(
                values, clamp=False, constant=False
            )
        chain += [Link.sure("scenario shift", light), Link.sure("the rest", last_light)]
    return chain, clean_model
