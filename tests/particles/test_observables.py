import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.special import j1
from scipy.stats import chi2

from jaxgran import observables as obs

BALL = {2: np.pi, 3: 4 / 3 * np.pi}
"""Volume of a ball of radius 1."""


def lattice(per_side, dimension):
    points = itertools.product(range(per_side), repeat=dimension)
    return np.array(list(points), float)


@pytest.mark.parametrize("dimension", [2, 3])
def test_sonine_coefficients_of_known_distributions(dimension):
    d = dimension
    one_speed = np.random.default_rng(d).normal(size=(1000, d))
    one_speed /= np.linalg.norm(one_speed, axis=1, keepdims=True)
    two_speeds = one_speed * np.repeat([1.0, 3.0], 500)[:, None]
    cube = np.array(list(itertools.product([-2.0, 0.0, 2.0], repeat=d)))  # <x^2> = 8/3, <x^4> = 6 x
    fourth = d * 32 / 3 + d * (d - 1) * 64 / 9
    a2 = -2 / (d + 2)
    batch = obs.sonine(jnp.stack([one_speed, 5 * two_speeds]))
    # Round-off of sums of 1000.
    np.testing.assert_allclose(batch, [a2, d / (d + 2) * 41 / 25 - 1], rtol=1e-12)
    exact = d / (d + 2) * fourth / (d * 8 / 3) ** 2 - 1
    assert obs.sonine(jnp.asarray(cube)) == pytest.approx(exact, rel=1e-12)
    # All of one speed: <v^6> = <v^2>^3, and the definition by <c^6>.
    exact = 1 + 3 * a2 - d**2 / ((d + 2) * (d + 4))
    assert obs.third_sonine(jnp.asarray(one_speed)) == pytest.approx(exact, rel=1e-12)
    # Errors sqrt(1 / (norm n)); S_2 has the norm d (d + 2) / 8, S_3 d (d + 2) (d + 4) / 48.
    maxwell = jax.random.normal(jax.random.key(0), (200_000, d))
    assert abs(obs.sonine(maxwell)) < 4 * np.sqrt(8 / (d * (d + 2) * 200_000))
    assert abs(obs.third_sonine(maxwell)) < 4 * np.sqrt(48 / (d * (d + 2) * (d + 4) * 200_000))


@pytest.mark.parametrize("dimension", [2, 3])
def test_ideal_gas_has_no_pair_correlation(dimension):
    n, side = 1500, 3.7
    rng = np.random.default_rng(0)
    edges = np.linspace(0, side / 2, 9)
    g = obs.pair_correlation(jnp.asarray(side * rng.random((n, dimension))), side, edges)
    ball = BALL[dimension] * (edges / side) ** dimension
    error = 1 / np.sqrt(n**2 / 2 * np.diff(ball))
    miss = (g - (1 - 1 / n)) / error  # a particle is no neighbour of itself
    assert np.all(np.abs(miss) < 4)
    assert np.sum(miss**2) < 8 + 4 * 4  # chi^2 of eight bins is 8 +- 4


@pytest.mark.parametrize(
    "dimension, shells",  # square lattice: 4 neighbours at 1, 4 at sqrt(2); cubic: 6 and 12
    [(2, (4, 0, 4)), (3, (6, 0, 12))],
)
def test_shells_of_a_lattice(dimension, shells):
    edges = np.array([0.9, 1.1, 1.3, 1.5])
    ball = BALL[dimension] * edges**dimension
    points = jnp.asarray(lattice(4, dimension) / 2)
    # A few centres see what all do.
    found = jax.jit(lambda side: obs.pair_correlation(points, side, edges / 2, 5))
    for g in (obs.pair_correlation(points, 2.0, edges / 2), found(2.0)):
        np.testing.assert_allclose(g, shells / np.diff(ball), rtol=1e-12)  # round-off
    # Beyond half of a side that could not be checked before.
    assert jnp.isnan(found(1.4)[-1])


@pytest.mark.parametrize("dimension", [2, 3])
def test_spectra_of_an_ideal_gas(dimension):
    def spectra(key):
        x, v = jax.random.split(key)
        position = 3.7 * jax.random.uniform(x, (50, dimension))
        velocity = 2.0 * jax.random.normal(v, (50, dimension))
        flow = obs.flow_spectrum(position, velocity, 3.7)[1:]
        return obs.structure_factor(position, 3.7)[1], *flow

    runs = 400
    shape, across, along = jax.jit(jax.vmap(spectra))(jax.random.split(jax.random.key(0), runs))
    # S = 1; T = 4 less what the mean velocity takes, 1/50. A mode is exponential; k and -k are one.
    T = 4 * (1 - 1 / 50)
    for found, modes in ((shape, 2), (across / T, (dimension - 1) * 2), (along / T, 2)):
        np.testing.assert_allclose(jnp.mean(found, axis=0), 1.0, atol=4 / np.sqrt(modes * runs))


@pytest.mark.parametrize("dimension, squares", [(2, (1, 2, 4, 5, 8)), (3, (1, 2, 3, 4, 5))])
def test_shells_of_wave_vectors(dimension, squares):
    points = np.ones((7, dimension))
    k, shape = obs.structure_factor(points, 3.7, num_shells=5)
    np.testing.assert_allclose(k, 2 * np.pi / 3.7 * np.sqrt(squares), rtol=1e-15)
    np.testing.assert_allclose(shape, 7.0, rtol=1e-14)  # all in one place: N
    k, shape = obs.structure_factor(points, 3.7)
    assert k.shape == shape.shape == (4,)


@pytest.mark.parametrize("dimension", [2, 3])
def test_structure_factor_of_layers_and_waves(dimension):
    points, side = lattice(8, dimension), 8.0
    n = len(points)
    _, shape = obs.structure_factor(points, side)
    np.testing.assert_allclose(shape, 0.0, atol=1e-25)  # squares of round-off
    # Particles on one plane: N for the waves across it, none for those along it.
    layer = points * np.array([0.0] + [1.0] * (dimension - 1))
    _, shape = obs.structure_factor(layer, side)
    np.testing.assert_allclose(shape[0], n / dimension, rtol=1e-12)
    np.testing.assert_allclose(shape[1], 0.0, atol=1e-25)
    # A density wave along x: |sum exp(i k x)| / N is the Bessel function J_1 of its strength,
    # up to J_7 = 2e-9 of the eight points.
    strength = 0.5
    wave = points.copy()
    phase = 2 * np.pi * points[:, 0] / side
    wave[:, 0] += strength * side / (2 * np.pi) * np.sin(phase)
    _, shape = obs.structure_factor(wave, side)
    np.testing.assert_allclose(shape[0], n * j1(strength) ** 2 / dimension, rtol=1e-6)


@pytest.mark.parametrize("dimension", [2, 3])
def test_velocity_distribution_of_a_maxwellian_gas(dimension):
    n, edges = 200_000, np.linspace(0, 2.5, 11)
    v = 0.3 * jax.random.normal(jax.random.key(dimension), (n, dimension)) + 5.0
    f = jax.jit(lambda v: obs.velocity_distribution(v, edges))(v)
    # Exact shares of the bins, of c^2, whose double is chi^2 of d degrees of freedom.
    share = np.diff(chi2.cdf(2 * edges**2, dimension))
    volume = BALL[dimension] * np.diff(edges**dimension)
    miss = (np.asarray(f) * volume - share) / np.sqrt(share / n)
    assert np.sum(miss**2) < 10 + 4 * np.sqrt(20)  # chi^2 of ten bins


def test_flow_spectrum_of_a_wave():
    # A shear wave v_y = sin(k x) on a lattice: all of it is transverse, in the first shell, where
    # it is two of the 2 d wave vectors; |j|^2 = N/4 for each of these. A sound wave v_x likewise.
    points = lattice(8, 3) + 0.3
    wave = np.sin(np.pi / 4 * points[:, :1])
    for shear in (True, False):
        velocity = wave * np.array([[0.0, 1.0, 0.0] if shear else [1.0, 0.0, 0.0]])
        k, across, along = obs.flow_spectrum(jnp.asarray(points), jnp.asarray(velocity), 8.0)
        found, none = (2 * across, along) if shear else (along, across)
        np.testing.assert_allclose(k, np.pi / 4 * np.sqrt([1, 2, 3, 4]), rtol=1e-14)
        np.testing.assert_allclose(found, [512 / 4 / 3, 0, 0, 0], rtol=1e-12, atol=1e-25)
        np.testing.assert_allclose(none, 0.0, atol=1e-25)  # squares of round-off


@pytest.mark.parametrize("dimension", [2, 3])
def test_flow_share(dimension):
    """All of a wave, a part of a wave that is added to heat, nothing of heat alone."""
    n, waves = 8**dimension, {2: 4, 3: 9}[dimension]
    points = lattice(8, dimension) + 0.3
    along = np.eye(dimension)[1]
    wave, short = (np.sin(k * points[:, :1]) * along for k in (np.pi / 4, np.pi / 2))
    even = 2 * waves / n  # by equipartition
    assert float(obs.flow_share(points, wave, 8.0)) == pytest.approx(1 - even, abs=1e-12)
    for nothing in (short, 0 * wave):
        assert float(obs.flow_share(points, nothing, 8.0)) == pytest.approx(-even, abs=1e-12)

    def of_heat(key):
        x, v = jax.random.split(key)
        position, heat = jax.random.uniform(x, points.shape), jax.random.normal(v, points.shape)
        return obs.flow_share(position, heat, 1.0)

    runs = 400
    found = jax.jit(jax.vmap(of_heat))(jax.random.split(jax.random.key(0), runs))
    spread = 2 * np.sqrt(waves / dimension) / n
    assert float(jnp.std(found)) == pytest.approx(spread, rel=4 / np.sqrt(2 * runs) + 2 / n)
    # The mean velocity takes 1/n of the energy, not of the waves.
    assert abs(float(jnp.mean(found))) < 4 * spread / np.sqrt(runs) + even / n


@pytest.mark.parametrize("dimension", [2, 3])
def test_cells(dimension):
    points = (lattice(4, dimension) + 0.5) / 2
    shear = np.where(points[:, :1] < 1, 1.0, -1.0) * np.eye(dimension)[-1]

    @jax.jit
    def found(points):
        flow = obs.cell_velocity(points, shear + 7.0, 2.0, 2)
        return obs.cell_density(points, 2.0, 2), flow, obs.number_fluctuation(points, 2.0, 2)

    density, flow, fluctuation = found(points)
    assert density.shape == (2,) * dimension
    np.testing.assert_array_equal(density, 1.0)
    assert fluctuation == 0
    np.testing.assert_array_equal(found(points - 6.0)[0], 1.0)  # an image
    sign = np.array([1.0, -1.0]).reshape((2,) + (1,) * (dimension - 1))
    np.testing.assert_allclose(flow[..., -1], np.broadcast_to(sign, density.shape), rtol=1e-13)
    np.testing.assert_allclose(flow[..., 0], 0.0, atol=1e-13)
    _, flow, fluctuation = found(np.full(points.shape, 0.1))  # all in the first cell
    clumped = (2**dimension - 1) * 2**dimension  # variance of the density, times the mean number
    assert fluctuation == pytest.approx(clumped, rel=1e-13)
    assert np.sum(np.isnan(flow[..., 0])) == 2**dimension - 1
