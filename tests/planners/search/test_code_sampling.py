from __future__ import annotations

import numpy as np

from nesy.dbn.inference.kernels import packed
from planners.search.code_sampling import alias_cells, next_code, packed_cells, sampler
from planners.search.random_bits import stream
from tests.planners.person_following.models import small_dbn


def test_alias_cells_hold_the_distribution() -> None:
    rng = np.random.default_rng(0)
    rows = rng.dirichlet(np.full(7, 0.3), 200)
    rows[0] = np.eye(7)[3]
    rows[1] = 1 / 7
    rows[2] = [0.5, 0, 0, 0.5, 0, 0, 0]
    cells = alias_cells(rows)
    other, threshold = np.floor(cells).astype(int), cells % 1
    again = np.zeros_like(rows)
    for k in range(7):
        again[:, k] += threshold[:, k] / 7
        np.add.at(again, (np.arange(200), other[:, k]), (1 - threshold[:, k]) / 7)
    assert np.allclose(again, rows, atol=1e-12)
    packed_again, cells = np.zeros_like(rows), packed_cells(cells, 3).astype(np.int64)
    threshold = (cells >> 3) / 2**29
    for k in range(7):
        packed_again[:, k] += threshold[:, k] / 7
        np.add.at(packed_again, (np.arange(200), cells[:, k] & 7), (1 - threshold[:, k]) / 7)
    assert np.allclose(packed_again, rows, atol=2e-9)
    assert (packed_again[rows == 0] == 0).all()  # what is impossible is never drawn


def test_drawn_codes_have_the_models_distribution() -> None:
    dbn = small_dbn(np.random.default_rng(1))
    codes, bits = sampler(packed(dbn)), stream(np.random.default_rng(2))
    now, out = np.array([1, 0], np.int16), np.zeros(4, np.int16)
    draws = 20_000
    counts = np.zeros((2, 2))
    for _ in range(draws):
        next_code(codes, now, 0, 2, out, 1, bits)
        counts[out[1], out[2]] += 1 / draws
    for i in range(2):
        for j in range(2):
            assert abs(counts[i, j] - np.exp(dbn.log_prob(now, 2, np.array([i, j])))) < 0.015
