"""How a fibre scatters: its energy, its sampler, its table, and where it is not reciprocal."""

import numpy as np
import pytest
from oracles import chi_square
from test_warp import SIGNIFICANT, counts_of_bins, share_of_bins

from ddprt.scene.material import Fibre
from ddprt.transport import fibre

ROUGH = [(0.1, 0.2), (0.3, 0.3), (0.9, 0.7)]
SINES = [-0.9, 0.0, 0.4]


def held_at(sine: float, offset: float, count: int, of: Fibre, absorption: float = 0.0) -> np.ndarray:
    return fibre.prepared(np.full(count, sine), np.full(count, offset), np.full((count, 3), absorption), of)


def whole(held: np.ndarray, shape: np.ndarray) -> float:
    """Sum of one fibre's phase over all directions, by midpoints over height and turn: lobes are some 10 cells wide."""
    cells = 256
    middle = (np.arange(cells) + 0.5) / cells
    z, turn = (axis.ravel() for axis in np.meshgrid(2 * middle - 1, 2 * np.pi * middle, indexing="ij"))
    flat = np.sqrt(1 - z**2)
    directions = np.stack([z, flat * np.cos(turn), flat * np.sin(turn)], 1)
    values = fibre.phase(np.tile(held, (len(directions), 1)), shape, directions)
    return float(values[:, 0].sum(dtype=np.float64)) * 4 * np.pi / cells**2


@pytest.mark.parametrize("rough", ROUGH)
@pytest.mark.parametrize("sine", SINES)
def test_a_white_fibre_keeps_its_energy(rough: tuple[float, float], sine: float) -> None:
    of = Fibre(*rough)
    for offset in (-0.95, 0.1, 0.7):
        # The issue asks for 0.5 %. Bessel's series is good to 2e-7, and the sum over smooth lobes to much better than 1e-3.
        assert whole(held_at(sine, offset, 1, of), fibre.shape_of(of)) == pytest.approx(1, abs=1e-3)


def test_what_is_absorbed_follows_from_chords() -> None:
    """Light that crosses a fibre without scales along a diameter: Fresnel's reflectance, then Beer's law, summed by hand."""
    depth, index, of = 0.35, 1.55, Fibre(tilt_deg=0.0)
    mirrored, passed = ((index - 1) / (index + 1)) ** 2, np.exp(-2 * depth)
    expected = mirrored + (1 - mirrored) ** 2 * passed / (1 - mirrored * passed)
    assert whole(held_at(0.0, 0.0, 1, of, depth), fibre.shape_of(of)) == pytest.approx(expected, abs=1e-3)


@pytest.mark.parametrize("rough", ROUGH)
@pytest.mark.parametrize(("sine", "offset", "absorption"), [(0.0, 0.3, 0.0), (0.6, -0.8, 0.2)])
def test_directions_fit_their_density(rough: tuple[float, float], sine: float, offset: float, absorption: float) -> None:
    of, count = Fibre(*rough), 100_000
    shape, held = fibre.shape_of(of), held_at(sine, offset, count, of, absorption)
    directions, weight = fibre.sample(held, shape, np.random.default_rng(0).random((count, 4)))
    np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1, atol=1e-6)

    def density(towards: np.ndarray) -> np.ndarray:
        """Bins are of height along z; fibres lie along x."""
        turned = np.roll(towards.reshape(-1, 3), 1, axis=1)
        return fibre.pdf(np.tile(held[:1], (len(turned), 1)), shape, turned).astype(np.float64).reshape(towards.shape[:-1])

    share = share_of_bins(density, -1.0, fine=32)
    assert share.sum() == pytest.approx(1, abs=1e-3)
    assert chi_square(counts_of_bins(np.roll(directions, -1, axis=1), -1.0), share) > SIGNIFICANT
    expected = fibre.phase(held, shape, directions) / fibre.pdf(held, shape, directions)[:, None]
    np.testing.assert_allclose(weight, expected, rtol=2e-4)  # float32 of sharp lobes: 1e-7 over a variance of 0.006, squared


def test_gains_are_the_other_side_of_the_same_sums() -> None:
    """Both ways of averaging over viewer and light: B = pi mean(phase / density) seen from anywhere, and mean gain of light."""
    of, count, rng = Fibre(0.3, 0.3), 200_000, np.random.default_rng(1)
    table = fibre.gains(of)
    for absorption in (0.0, 0.05, 0.8):
        turn = rng.uniform(-np.pi / 2, np.pi / 2, 4 * count)
        turn = turn[rng.random(4 * count) < np.cos(turn) ** 2][:count]  # seen by the cosine, over solid angle
        held = fibre.prepared(np.sin(turn), rng.uniform(-1, 1, count), np.full((count, 3), absorption), of)
        directions, weight = fibre.sample(held, fibre.shape_of(of), rng.random((count, 4)))
        grid = np.linspace(-np.pi / 2, np.pi / 2, 2001)[1:-1]
        values = fibre.gain(table, np.sin(grid), np.full((len(grid), 3), absorption))[:, 0] * np.cos(grid) ** 2
        whole = 2 / np.pi * values.mean() * np.pi * len(grid) / (len(grid) + 1)
        deviation = float(weight[:, 0].std()) / np.sqrt(count)
        assert whole == pytest.approx(float(weight[:, 0].mean()), abs=4 * deviation + 5e-4)  # and the table's own 2e-4
        # Not only in sum: light from the upper third of angles counts as often as it is drawn.
        upper = np.arcsin(np.clip(directions[:, 0], -1, 1)) > np.pi / 6
        part = 2 * (values * (grid > np.pi / 6)).sum() / (len(grid) + 1)
        drawn = weight[:, 0] * upper
        assert part == pytest.approx(float(drawn.mean()), abs=4 * float(drawn.std()) / np.sqrt(count) + 2e-3)


def test_colours_absorb_as_told() -> None:
    np.testing.assert_array_equal(fibre.absorption_of(np.ones(3), 0.3), np.zeros(3))
    smooth = fibre.absorption_of(np.array([np.exp(-5.969)] * 3), 0.0)
    np.testing.assert_allclose(smooth, 1.0)  # by the first coefficient alone
    dark, light = fibre.absorption_of(np.array([[0.1] * 3, [0.8] * 3]), 0.3)
    assert (dark > light).all()


def test_it_is_not_reciprocal_and_says_so() -> None:
    """Longitudinal and azimuthal parts are symmetric, what a lobe loses is not: exchange of sides changes the phase."""
    of, rng = Fibre(tilt_deg=0.0), np.random.default_rng(2)
    one, other = rng.uniform(-0.8, 0.8, (2, 2000))
    turn = rng.uniform(-np.pi, np.pi, 2000)
    offset = np.zeros(2000)

    def mean_phase(seen: np.ndarray, lit: np.ndarray) -> np.ndarray:
        flat = np.sqrt(1 - lit**2)
        directions = np.stack([lit, flat * np.cos(turn), flat * np.sin(turn)], 1)
        return fibre.phase(fibre.prepared(seen, offset, np.zeros((2000, 3)), of), fibre.shape_of(of), directions)[:, 0]

    there, back = mean_phase(one, other), mean_phase(other, one)
    assert 1e-3 < np.median(np.abs(there / back - 1)) < 0.2
    assert "not reciprocal" in (fibre.__doc__ or "")
