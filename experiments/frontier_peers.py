"""The quick part of `experiments/frontier.py` about peers: a fit and frames beside the fastest accurate ones alone."""

from collections.abc import Sequence
from dataclasses import replace

import jax.numpy as jnp
import numpy as np
from threadpoolctl import threadpool_limits

from ddprt.bench.peers import fit, relight, roofline
from ddprt.bench.peers.peers import GRAM, Sizes
from ddprt.bench.peers.standing import OURS, Peer, Row, best, compare
from ddprt.config import Config
from ddprt.progress import Progress

QUIET = Progress(quiet=True)
QUICK_FIT = (OURS, "sklearn PCA, covariance_eigh", GRAM)
QUICK_RELIGHT = (OURS, "numpy B.T @ u.T, into an array")


def quick_peers(base: Config) -> dict[str, float | None]:
    """The fit of a fiftieth of the texels and cold frames, beside the fastest accurate peers of the whole comparison alone."""
    sizes = Sizes(texels=20_000, repeats=3)
    with threadpool_limits(limits=roofline.threads()):
        spectrum = fit.real_spectrum(base, 3 * sizes.lightings, QUIET)
        maps = fit.Maps(fit.make_columns(spectrum, sizes.texels, base.seed), sizes.bases)
        fits = compare(_kept(fit.PEERS, QUICK_FIT), maps, repeats=sizes.repeats)
        show(f"fit of {sizes.bases} bases to {len(spectrum)} columns x {sizes.texels} texels", fits)
        del maps
        scenes = cold_scenes(sizes, base.seed)
        frames = compare(_kept(relight.RELIGHT, QUICK_RELIGHT), scenes, repeats=3 * sizes.repeats)
        moved = scenes.moved
        show(f"a frame of {sizes.side} x {sizes.side} texels, {len(scenes.models)} models in turn", frames)
        del scenes
        stream = roofline.triad(sizes.bases, 3, repeats=sizes.repeats)
    ours, first = (next(row for row in frames if row.name == OURS), best(fits))
    assert ours.seconds is not None
    fraction = moved / ours.seconds.median / stream.rate
    print(f"stream {stream.rate / 1e9:.3g} GB/s, a frame {fraction:.1%} of it")
    return {
        "relight_bandwidth_fraction": round(fraction, 4),
        "fit_speedup_best_peer": float(f"{first.ratio:.4g}") if first and first.ratio else None,
    }


def _kept(peers: Sequence[Peer], names: Sequence[str]) -> list[Peer]:
    """Peers of these names; who is left out is said."""
    print("left out by --quick:", ", ".join(peer.name for peer in peers if peer.name not in names))
    return [peer for peer in peers if peer.name in names]


def show(what: str, rows: Sequence[Row]) -> None:
    """A comparison in few lines."""
    print(what)
    for row in rows:
        took = f"{row.ratio:.3g} x ours, {row.seconds.median:.3g} s" if row.seconds and row.ratio else "-"
        print(f"  {row.name}: {took}, {row.verdict}{f'; {row.reason}' if row.verdict == 'skipped' else ''}", flush=True)


def cold_scenes(sizes: Sizes, seed: int) -> relight.Scenes:
    """As many models as no cache holds: copies of one in memory of their own, which is all that bandwidth asks for."""
    texels = sizes.side**2
    first = relight.make_model(texels, sizes.bases, sizes.points, seed)
    linear = relight.learned(first)
    count = 1 + -(-roofline.BEYOND * roofline.cache_bytes().bytes // (4 * texels * sizes.bases))
    copies = [replace(first, relighter=replace(linear, basis=jnp.array(linear.basis, copy=True))) for _ in range(count - 1)]
    values = np.random.default_rng(seed).random((sizes.points, 3), np.float32)
    return relight.Scenes([first, *copies], values)
