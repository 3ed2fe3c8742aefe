"""The report: one HTML file that opens from disk, with everything in it."""

import base64
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ddprt import __version__
from ddprt.config import Config
from ddprt.dataset.store import Dataset
from ddprt.files import write_text
from ddprt.methods.statuses import STATUSES
from ddprt.report import figures, words
from ddprt.report.evaluate import Evaluation
from ddprt.report.lamps import on_picture
from ddprt.report.shots import shots
from ddprt.report.view import default_camera, take_view
from ddprt.runtime.model import Model
from ddprt.scene.mesh import Scene
from ddprt.scene.unwrap import unwrap
from ddprt.transport.effects import Effect
from ddprt.transport.embree import Tracer

# Limits past which a number becomes a warning.
_NOISE_SHARE = 1 / 3  # noise floor over projection floor
_MEAN_Z, _SPREAD_Z, _BIAS = 0.3, 1.5, 0.01  # of the spot check
_FEWEST = 30  # values of the spot check: the mean of fewer strays by more than half of _MEAN_Z by chance alone
_UNBIASED = (
    "Both are unbiased, so raise report.spot_check_samples and transport.test_samples; a difference that stays is a fault."
)
_NEGATIVE = 0.01  # negative energy over positive
_OUTSIDE = 0.5  # share of held-out lightings outside of what was trained on
_BOUND = 0.01  # light left out over the largest direct irradiance

_SUPERSCRIPT = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
_METHOD_KEYS = {
    "relative_rmse": ("relative RMSE", "percent"),
    "median_lighting_relative_rmse": ("median", "percent"),
    "p90_lighting_relative_rmse": ("90th pct.", "percent"),
    "worst_lighting_relative_rmse": ("worst", "percent"),
    "relative_mse": ("relative MSE", "short"),
    "psnr_db": ("PSNR (dB)", "one"),
    "energy_bias": ("energy bias", "signed"),
    "negative_share": ("negative light", "percent"),
    "median_negative_share": ("median", "percent"),
    "worst_negative_share": ("worst", "percent"),
    "fit_seconds": ("fit", "seconds"),
    "relight_seconds": ("relight", "seconds"),
    "bytes": ("size", "bytes"),
    "flops": ("operations", "count"),
    "bases": ("bases", "plain"),
    "status": ("status", "plain"),
    "psnr_peak": ("peak (W/m²)", "short"),
}


def write_page(
    path: str | Path,
    *,
    evaluation: Evaluation,
    data: Dataset,
    models: Mapping[str, Model],
    config: Config,
    stages: Sequence[Mapping[str, Any]] = (),
    scene: Scene | None = None,
    plan_effects: Sequence[Effect] | None = None,
    effect_costs: Mapping[str, Mapping[str, Any]] | None = None,
    command: str = "",
    budget: Mapping[str, Any] | None = None,
    seconds: Mapping[str, Sequence[float]] | None = None,
) -> Path:
    """Writes the report.

    Args:
      path: of the HTML file.
      evaluation: what was found, from `ddprt.report.evaluate`.
      data: the dataset it was found on.
      models: by name of their method; the first is the one whose pictures and numbers lead.
      config: the resolved configuration.
      stages: of the run, each {"name", "seconds", ...facts}; "rays" is shown as a rate too.
      scene: what was baked; without it the pictures are lightmaps alone.
      plan_effects: the plan's effects; None takes those that the dataset was baked with.
      effect_costs: rays, seconds and energy_share by name of the effect, where they are known.
      command: that makes this report again.
      budget: contents of budget.json, where the error was taken apart.
      seconds: by name of a learned method, since its training began, one for each entry of `FitReport.loss`; where known.
    Returns:
      The path.
    Raises:
      UserError: the file cannot be written.
      ValueError: no model.
    """
    if not models:
        raise ValueError("got no model, expected at least one to report on")
    from jinja2 import Environment, PackageLoader, StrictUndefined

    environment = Environment(
        loader=PackageLoader("ddprt", "report"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {"percent": words.percent, "seconds": words.seconds, "bytes": words.size, "count": words.count}
    environment.filters |= {"signed": _signed, "short": _short, "image": _image}
    effects = [Effect(**entry) for entry in data.description.get("plan", [])] if plan_effects is None else list(plan_effects)
    main = next(iter(models))
    page = environment.get_template("page.html.j2").render(
        version=__version__,
        metrics=evaluation.metrics,
        main=main,
        model=models[main],
        score=evaluation.metrics["methods"][main],
        report=models[main].relighter.report,
        data=data,
        config=config,
        ratio=_ratio(evaluation, main),
        warnings=warnings(
            evaluation,
            main,
            effects,
            data.description["scene"].get("notes", ()),
            data.description["transport"]["integrator"],
        ),
        columns=[label for label, _ in _METHOD_KEYS.values()],
        methods=method_table(evaluation.metrics["methods"]),
        plots=figures.plots(evaluation, {name: model.relighter.report for name, model in models.items()}, main, seconds)
        | ({"budget": figures.budget_bars(budget)} if budget else {}),
        learned=[name for name, model in models.items() if model.relighter.report.loss],
        budget=budget,
        check=evaluation.spot_check,
        enough=_enough(evaluation.spot_check),
        effects=effects,
        costs=effect_costs or {},
        stages=[dict(stage) for stage in stages],
        command=command,
        **_pictures(evaluation, data, main, models[main], config, scene),
    )
    write_text(Path(path), page)
    return Path(path)


def warnings(
    evaluation: Evaluation,
    main: str,
    effects: Sequence[Effect] = (),
    notes: Sequence[str] = (),
    integrator: str = "operator",
) -> list[tuple[str, str]]:
    """What a reader must know before the numbers: (title, paragraph), the gravest first."""
    metrics, check = evaluation.metrics, evaluation.spot_check
    scores, count = metrics["methods"], metrics["dark_test_lightings"]
    noise, projection = (metrics["floors"][f"{key}_relative_rmse"] for key in ("noise", "projection"))
    found = [
        (f"{name}: {remark}", _explained(remark, score.get("trouble", "")))
        for name, score in scores.items()
        for remark in score.get("remarks") or [score["status"]]
        if remark != "ok"
    ]
    if noise is not None and projection is not None and noise > _NOISE_SHARE * projection:
        text = (
            f"The held-out maps are uncertain by {words.percent(noise)}, more than a third of the projection floor "
            f"({words.percent(projection)}): part of every error is their noise. Raise transport.test_samples."
        )
        found.append(("Noisy references", text))
    bias = check.get("relative_bias")
    if _enough(check) and (abs(check["mean"]) > _MEAN_Z or check["std"] > _SPREAD_Z or abs(bias or 0) > _BIAS):
        much = "not known" if bias is None else f"{_signed(100 * bias, 2)}\u00a0%"
        text = (
            f"The z-scores of baked minus traced light have mean {_signed(check['mean'], 2)} and standard deviation "
            f"{check['std']:.2f}, and the bias is {much}; expected are 0, 1 and 0. "
            "The bake disagrees with the unbiased integrator by more than noise. "
            + ("Raise transport.sender_resolution." if integrator == "operator" else _UNBIASED)
        )
        found.append(("Spot check", text))
    if count:
        text = (
            f"{count} of {metrics['lightings']['test']} held-out lightings bring no indirect light. They count in pooled "
            "errors but have no relative error of their own. Their lamps may stand inside a solid or outside the room."
        )
        found.append(("Dark test lightings", text))
    unlit = sum(layer.get("unlit", 0) for layer in metrics.get("layers", {}).values())
    if unlit:
        text = (
            f"{unlit} in free air get no light under any lighting: outside of a closed room, or where no lamp is. "
            "Objects there would be black. Move the grid (probes.region_low and region_high)."
        )
        found.append(("Probes without light", text))
    trust = metrics.get("trust") or {}
    if (trust.get("flagged_share") or 0) > _OUTSIDE:
        found.append(("Held-out lightings of another kind", STATUSES["extrapolating"]))
    if trust.get("unseen"):
        found.append((f"{trust['unseen']} held-out lightings that no point sees", STATUSES["blind"]))
    share = scores[main]["negative_share"]
    if share is None or share > _NEGATIVE:
        much = "all there is" if share is None else f"{words.percent(share)} of the positive"
        found.append(("Negative light", f"Before the clamp, the negative part of the prediction is {much}."))
    for effect in effects:
        if effect.forced or effect.bound is None or (not effect.called and effect.bound > _BOUND):
            most = None if effect.bound is None else words.percent(effect.bound)
            share = f"at most {most} of the largest direct" if most else "an unbounded share of the largest direct"
            found.append((f"Effect cut short: {effect.name}", f"{effect.why}; {share} irradiance is left out."))
    return [*found, *(("Scene repaired on loading", note) for note in notes)]


def _explained(remark: str, trouble: str) -> str:
    told = f"{trouble[:1].upper()}{trouble[1:]}. " if trouble and remark == "diverged" else ""
    return told + STATUSES.get(remark, "This status has no description.")


def _enough(check: Mapping[str, Any]) -> bool:
    """Whether the spot check has the values that its numbers say something with."""
    return bool(check) and check["count"] >= _FEWEST


def method_table(methods: Mapping[str, Mapping[str, Any]]) -> list[tuple[str, list[str]]]:
    """Rows of (name, cells in the order of the columns), best first."""
    order = sorted(methods, key=lambda name: (methods[name]["relative_rmse"] is None, methods[name]["relative_rmse"] or 0))
    forms: dict[str, Callable[[Any], str]] = {"percent": words.percent, "short": _short, "seconds": words.seconds}
    forms |= {
        "bytes": words.size,
        "count": words.count,
        "plain": str,
        "one": lambda value: f"{value:.1f}",
        "signed": lambda value: _signed(100 * value, 2) + "\u00a0%",
    }
    rows = []
    for name in order:
        cells = [(methods[name].get(key), forms[form]) for key, (_, form) in _METHOD_KEYS.items()]
        rows.append((name, ["–" if value is None else form(value) for value, form in cells]))
    return rows


def _pictures(
    evaluation: Evaluation, data: Dataset, main: str, model: Model, config: Config, scene: Scene | None
) -> dict[str, Any]:
    view, tracer, seen = None, None, []
    if scene is not None:
        atlas = data.description["atlas"]
        tracer = Tracer.of(scene, config.transport.threads)
        laid = data.imported or scene.tubes is not None  # strands have texels along them, not charts
        uv = data.uv if laid else unwrap(scene, atlas["resolution"], atlas["padding"])[0]
        assert uv is not None
        view = take_view(tracer, uv, data.covered, default_camera(scene))
        seen = shots(evaluation, data, main, model, scene, tracer, uv, config.report.views)
    truth, predicted, test = evaluation.truth, evaluation.predicted[main], data.split("test")
    errors, albedo, rows = truth.errors_per_lighting(predicted), data.gbuffer["albedo"], []
    for row, label in figures.choose_rows(errors, config.report.rows):
        direct, reference = data.shaded([test[row]])[0], truth.reference[row]
        pictures = figures.lighting_row(direct, predicted[row], reference, albedo, data.covered, view)
        mean = float(np.average(reference.mean(1), weights=truth.weight))
        distance = float(evaluation.distance[row]) if len(evaluation.distance) else np.nan
        lamps = [light.anchor() for light in data.lightings[test[row]]]
        facts = {
            "index": test[row],
            "label": label,
            "error": float(errors[row]),
            "share": pictures["limit"] / mean,
            "mean": mean,
        }
        facts |= {"distance": distance if np.isfinite(distance) else None, "kinds": _kinds(data, test[row])}
        rows.append({**pictures, **facts, "lamps": on_picture(view.camera, lamps) if view else []})
    basis = getattr(model.relighter, "basis", None)
    bases = [] if basis is None else figures.basis_pictures(np.asarray(basis), data.covered, view)
    points: tuple[bytes, ...] = ()
    if view is not None and tracer is not None:
        points = figures.points_pictures(data, model.points, tracer, view, truth.reference.mean(0))
    aspect = view.camera.aspect if view else 1.0
    return {"rows": rows, "basis_pictures": bases, "points_pictures": points, "aspect": aspect, "shots": seen}


def _kinds(data: Dataset, index: int) -> str:
    kinds = [light.kind for light in data.lightings[index]]
    return ", ".join(f"{kinds.count(kind)} {kind}" for kind in dict.fromkeys(kinds))


def _ratio(evaluation: Evaluation, main: str) -> float | None:
    error, floor = (
        evaluation.metrics["methods"][main]["relative_rmse"],
        evaluation.metrics["floors"]["projection_relative_rmse"],
    )
    return error / floor if error is not None and floor else None


def _signed(value: float | int, digits: int) -> str:
    return f"{value:+.{digits}f}".replace("-", "−")


def _short(value: Any) -> str:
    """Three digits; large and small numbers as 1.2·10⁻⁶."""
    if not isinstance(value, float):
        return str(value)
    digits, _, power = f"{value:.3g}".partition("e")
    return f"{digits}·10{str(int(power)).translate(_SUPERSCRIPT)}" if power else digits


def _image(picture: bytes) -> str:
    """The address of a picture that stands in the page itself."""
    return "data:image/png;base64," + base64.b64encode(picture).decode()
