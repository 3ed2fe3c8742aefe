"""`ddprt bench --peers`: ours and everyone else's way to the same result, side by side in one run on one machine.

Equal accuracy first, then time: who is less accurate than we are is shown with the error, and not ranked. Where a limit of the
machine applies, it is measured in the same run.
"""

import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from importlib import import_module
from typing import Any

import jax
from threadpoolctl import threadpool_limits

from ddprt.bench.peers import fit, ridge, roofline
from ddprt.bench.peers.fit import Maps, fit_rows, make_columns, real_spectrum
from ddprt.bench.peers.relight import RELIGHT, TRANSFER, make_frames, make_model, make_scenes, relight_rows, transfer_rows
from ddprt.bench.peers.ridge import make_pairs, ridge_rows
from ddprt.bench.peers.standing import OURS, Row, best
from ddprt.config import Config
from ddprt.machine import commit, installed, machine
from ddprt.progress import Progress

GRAM = "NumPy Gram product"


@dataclass(frozen=True)
class Sizes:
    """How much is compared.

    Attributes:
      texels: of the fit.
      lightings: of the fit; each has three columns.
      bases, points: of everything.
      side: texels of a frame per side.
      frames: of a batch.
      repeats: turns of each comparison.
      limit: seconds that one run of a peer may take.
      product: rows of the factors that the peak is measured with.
      disk: bytes read.
      stream: bytes of the buffers of streaming kernels and of the models that are taken in turn; None: four times the cache.
    """

    texels: int = 1_000_000
    lightings: int = 128
    bases: int = 16
    points: int = 256
    side: int = 1024
    frames: int = 1024
    repeats: int = 7
    limit: float | int = 120
    product: int = 3072
    disk: int = 512 << 20
    stream: int | None = None


QUICK = Sizes(texels=100_000, repeats=3, limit=4, product=1536, disk=128 << 20)


def peers(config: Config, progress: Progress, *, quick: bool = False) -> dict[str, Any]:
    """Compares fit, transfer and relighting with their peers.

    Args:
      config: its scene gives the spectrum, its seed the random numbers; sizes are fixed.
      progress: shown.
      quick: a tenth of the texels for the fit, fewer repeats.
    Returns:
      machine, versions, commit, `threads` that everyone had, `limits` of the machine, `comparisons` with a row for every
      peer, and `summary`, the figures that targets are set for. Plain values; `table` prints them.
    Raises:
      UserError: the scene cannot be loaded or baked.
    """
    return measure(config, progress, QUICK if quick else Sizes())


def measure(config: Config, progress: Progress, sizes: Sizes) -> dict[str, Any]:
    """What `peers` does, at any size."""
    count = roofline.threads()
    with _same_threads(count):
        limits = _limits(sizes, progress)
        comparisons = [
            *_fits(config, sizes, progress),
            *_frames(config.seed, sizes, limits, progress),
            _bake(),
        ]
    packages = {name: installed(name) for name in ("scikit-learn", "torch", "mitsuba")}
    return {
        "machine": machine() | {"peers": packages, "backend": jax.default_backend()},
        "commit": commit(),
        "threads": count,
        "sizes": vars(sizes),
        "limits": {name: limit.record() for name, limit in limits.items() if not isinstance(limit, roofline.Cache)}
        | {"cache": vars(limits["cache"])},
        "comparisons": comparisons,
        "summary": _summary(comparisons),
    }


def _limits(sizes: Sizes, progress: Progress) -> dict[str, Any]:
    with progress.stage("limits of the machine"):
        frame = 4 * sizes.side**2 * (sizes.bases + 3)
        return {
            "cache": roofline.cache_bytes(),
            "stream": roofline.triad(sizes.bases, 3, sizes.stream, repeats=sizes.repeats),
            "stream of one frame": roofline.triad(sizes.bases, 3, frame, repeats=sizes.repeats),
            "float32 product": roofline.matrix_product_peak("float32", size=sizes.product, repeats=sizes.repeats),
            "float64 product": roofline.matrix_product_peak("float64", size=sizes.product, repeats=sizes.repeats),
            "disk": roofline.disk_read_rate(tempfile.gettempdir(), bytes=sizes.disk),
        }


def _fits(config: Config, sizes: Sizes, progress: Progress) -> Iterator[dict[str, Any]]:
    spectrum = real_spectrum(config, 3 * sizes.lightings, progress)
    with progress.stage("fit", len(fit.PEERS)) as stage:
        maps = Maps(make_columns(spectrum, sizes.texels, config.seed), sizes.bases)
        rows = fit_rows(maps, repeats=sizes.repeats, limit=sizes.limit, tell=stage.advance)
        what = f"fit of {sizes.bases} bases to {len(spectrum)} columns x {sizes.texels} texels, float32"
        yield _comparison("fit", what, rows, maps.blur)
    with progress.stage("transfer fit", len(ridge.PEERS)) as stage:
        pairs = make_pairs(spectrum[: sizes.lightings], sizes.points, sizes.bases, config.seed)
        rows = ridge_rows(pairs, repeats=sizes.repeats * 3, tell=stage.advance)
        what = f"ridge map of {sizes.lightings} lightings, {sizes.points} points to {sizes.bases} coefficients"
        yield _comparison("transfer fit", what, rows, pairs.blur)


def _frames(seed: int, sizes: Sizes, limits: dict[str, Any], progress: Progress) -> Iterator[dict[str, Any]]:
    texels = sizes.side**2
    away = sizes.stream or roofline.BEYOND * limits["cache"].bytes
    for name, models, limit in (
        ("relight, cold", 1 + -(-away // (4 * texels * sizes.bases)), "stream"),
        ("relight, warm", 1, "stream of one frame"),
    ):
        with progress.stage(name, len(RELIGHT)) as stage:
            scenes = make_scenes(texels, sizes.bases, sizes.points, models, seed)
            rows = relight_rows(scenes, repeats=3 * sizes.repeats, tell=stage.advance)
            what = f"a frame of {sizes.side} x {sizes.side} texels from {sizes.bases} bases, RGB; {models} models in turn"
            yield _comparison(name, what, rows, scenes.blur, limit, scenes.moved / limits[limit].rate)
            del scenes
    model = make_model(1024, sizes.bases, sizes.points, seed)
    for name, one in (("transfer, one frame", True), ("transfer, batch", False)):
        with progress.stage(name, len(TRANSFER)) as stage:
            frames = make_frames(model, sizes.frames, seed, one=one)
            rows = transfer_rows(frames, repeats=5 * sizes.repeats, tell=stage.advance)
            what = f"{sizes.bases} x {sizes.points} x RGB, " + (
                "frames one by one" if one else f"{sizes.frames} frames at once"
            )
            bound = frames.flops / len(frames.values) / limits["float32 product"].rate
            yield _comparison(name, what, rows, frames.blur, "float32 product", bound)


def _comparison(
    name: str, what: str, rows: Sequence[Row], blur: dict[str, float], limit: str = "", bound: float = 0.0
) -> dict[str, Any]:
    """Plain values; `bound` is the seconds that the machine's limit allows for."""
    found = [
        row.record() | ({"share_of_limit": round(bound / row.seconds.median, 4)} if bound and row.seconds else {})
        for row in rows
    ]
    first = best(rows)
    return {
        "name": name,
        "what": what,
        "best_peer": first.name if first else None,
        "speedup_best_peer": float(f"{first.ratio:.4g}") if first and first.ratio else None,
        "told_apart": {key: float(f"{value:.3g}") for key, value in blur.items()},
        "limit": limit,
        "rows": found,
    }


def _bake() -> dict[str, Any]:
    reason = "takes minutes and a process of Mitsuba's own: python experiments/bake_speed.py --quick (docs/baking.md)"
    if installed("mitsuba") is None:
        reason = f'mitsuba is not installed; pip install "ddprt[reference]"; then: {reason}'
    row = Row("Mitsuba 3", "skipped", reason=reason)
    return _comparison("bake", "indirect light of many lightings", [row], {})


def _summary(comparisons: Sequence[dict[str, Any]]) -> dict[str, float | None]:
    by_name = {entry["name"]: entry for entry in comparisons}

    def ours(name: str) -> dict[str, Any]:
        return next(row for row in by_name[name]["rows"] if row["name"] == OURS)

    gram = next(row["ratio"] for row in by_name["fit"]["rows"] if row["name"] == GRAM)
    one, batch = ours("transfer, one frame"), ours("transfer, batch")
    return {
        "fit_speedup_best_peer": by_name["fit"]["speedup_best_peer"],
        "fit_over_gram": None if gram is None else float(f"{1 / gram:.4g}"),
        "relight_bandwidth_fraction": ours("relight, cold")["share_of_limit"],
        "relight_bandwidth_fraction_warm": ours("relight, warm")["share_of_limit"],
        "relight_speedup_best_peer": by_name["relight, cold"]["speedup_best_peer"],
        "transfer_microseconds": float(f"{1e6 * one['seconds']['median']:.4g}"),
        "transfer_frames_per_second": float(f"{1 / batch['seconds']['median']:.4g}"),
        "transfer_product_fraction": batch["share_of_limit"],
    }


def table(record: dict[str, Any]) -> str:
    """A record of `peers` as Markdown: ratios first, errors beside them."""
    where = record["machine"]
    versions = {**where["packages"], **where["peers"]}
    told = ", ".join(
        f"{name} {versions[name]}" for name in ("numpy", "scipy", "jax", "scikit-learn", "torch") if versions.get(name)
    )
    lines = [
        f"{where['processor']}, {record['threads']} threads for everyone, {told}, commit {record['commit'] or 'unknown'}",
        "",
    ]
    for name, limit in record["limits"].items():
        said = (
            f"{limit['bytes'] / 2**20:.0f} MiB ({limit['source']})"
            if name == "cache"
            else f"{limit['rate']:.4g} {limit['unit']}"
        )
        lines.append(f"- {name}: {said}{'; ' + limit['remark'] if limit.get('remark') else ''}")
    for entry in record["comparisons"]:
        lines += ["", f"## {entry['name']}: {entry['what']}"]
        limited = f" share of {entry['limit']} |" if entry["limit"] else ""
        lines += [f"| time / ours | who | seconds (quartiles) |{limited} error | standing |"]
        lines += ["| --- | --- | --- |" + (" --- |" if limited else "") + " --- | --- |"]
        lines += [_line(row, bool(limited)) for row in entry["rows"]]
        if entry["told_apart"]:
            bounds = ", ".join(f"{name} {value:.1e}" for name, value in entry["told_apart"].items())
            lines.append(f"\nErrors that rounding alone makes, not told apart: {bounds}.")
    return "\n".join(lines) + "\n"


def _line(row: dict[str, Any], limited: bool) -> str:
    if row["seconds"] is None:
        return f"| - | {row['name']} | - |{' - |' if limited else ''} - | {row['verdict']}: {row['reason']} |"
    took = row["seconds"]
    seconds = f"{took['median']:.3g} ({took['low']:.3g} to {took['high']:.3g})"
    seconds += f" + {took['compile']:.2g} once" if took["compile"] else ""
    share = f" {row['share_of_limit']:.1%} |" if limited else ""
    errors = ", ".join(f"{name} {value:.1e}" for name, value in row["errors"].items()) or "-"
    standing = row["verdict"] + (f"; {row['reason']}" if row["reason"] else "")
    return f"| {row['ratio']:.3g} | {row['name']} | {seconds} |{share} {errors} | {standing} |"


@contextmanager
def _same_threads(count: int) -> Iterator[None]:
    """BLAS, OpenMP and torch with as many threads as JAX takes."""
    torch: Any = None
    with suppress(ImportError):
        torch = import_module("torch")
    before = torch.get_num_threads() if torch else 0
    with threadpool_limits(limits=count):
        if torch:
            torch.set_num_threads(count)
        try:
            yield
        finally:
            if torch:
                torch.set_num_threads(before)
