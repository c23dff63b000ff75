import heapq

import jax.numpy as jnp
import numpy as np
import pytest

import jaxgran
from jaxgran.particles.hard.prediction import PairRows, Paths, first_impacts
from tests.pairs import find_pairs


@pytest.mark.slow
def test_disturbances_go_from_sphere_to_sphere_as_far_as_they_can():
    # Who is disturbed when, by Dijkstra's algorithm: the earliest disturbance is final, and sends
    # others to its neighbours, at the bound on speeds.
    gas = jaxgran.Gas(
        jaxgran.ConstantRestitution(1.0),
        diameter=1.0,
        mass=1.0,
        packing_fraction=0.3,
        temperature=1.0,
    )
    n = 200
    start = jaxgran.cool(gas, [0.0], model=jaxgran.HardSpheres(n)).particles
    x, v = start.position.reshape(n, 3), start.velocity.reshape(n, 3)
    pairs = find_pairs(x, start.box_side, 2.0, capacity=10 * n)
    real, bound, end = jnp.arange(10 * n) < pairs.count, 5.0, 0.04
    rows = PairRows(pairs.i, pairs.j, pairs.offset, jnp.full(10 * n, bound), real)
    *_, final = first_impacts(Paths(x, v, jnp.zeros(n)), rows, end)

    i, j, offset = (np.asarray(values)[: int(pairs.count)] for values in pairs[:3])
    r, w = np.asarray(x)[i] - np.asarray(x)[j] - offset, np.asarray(v)[i] - np.asarray(v)[j]
    near = {k: [] for k in range(n)}
    for row, (a, b) in enumerate(zip(i, j, strict=True)):
        near[a].append((b, row))
        near[b].append((a, row))
    expected, sent_by = np.full(n, np.inf), {}
    for row, (a, b) in enumerate(zip(i, j, strict=True)):
        c = w[row] @ w[row], 2 * r[row] @ w[row], r[row] @ r[row] - 1
        roots = np.roots(c)
        if c[1] < 0 and np.all(np.isreal(roots)) and 0 <= min(roots.real) < end:
            for k in (a, b):
                expected[k] = min(expected[k], min(roots.real))
    queue = [(t, k, 0) for k, t in enumerate(expected) if t < end]
    heapq.heapify(queue)
    while queue:
        t, k, hops = heapq.heappop(queue)
        if t > expected[k]:
            continue
        sent_by[k] = hops
        for other, row in near[k]:
            gap = max(np.linalg.norm(r[row] + w[row] * t) - 1, 0.0)
            there = t + gap / (bound + np.linalg.norm(v[other]))
            if there < min(expected[other], end):
                expected[other] = there
                heapq.heappush(queue, (there, other, hops + 1))
    assert max(sent_by.values()) >= 4  # a way that one sweep does not go
    disturbed = expected < end
    assert 0.5 < np.mean(disturbed) < 0.9  # and some are left in peace
    np.testing.assert_array_equal(np.asarray(final) < end, disturbed)
    # Round-off of times of impact, 4e-15 in this gas.
    np.testing.assert_allclose(np.asarray(final)[disturbed], expected[disturbed], rtol=1e-13)
