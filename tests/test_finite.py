"""Inline tests of numbers against NumPy's, at every bit pattern that could fool them."""

import numpy as np
import pytest
import warp as wp

from wavefront.finite import is_finite, is_finite3, is_radiance

DEVICE = "cpu"
MAX, TINY = np.finfo(np.float32).max, np.float32(1.4e-45)
VALUES = np.array([0.0, -0.0, 1.0, -1.0, TINY, -TINY, MAX, -MAX, np.inf, -np.inf, np.nan, -np.nan], np.float32)


@wp.kernel(enable_backward=False, module="unique")
def answers(v: wp.array(dtype=wp.vec3), result: wp.array(dtype=wp.vec3i)):
    i = wp.tid()
    result[i] = wp.vec3i(int(is_finite(v[i][0])), int(is_finite3(v[i])), int(is_radiance(v[i])))


@pytest.fixture(scope="module")
def answered():
    v = np.stack(np.meshgrid(VALUES, VALUES, VALUES, indexing="ij"), axis=-1).reshape(-1, 3)
    result = wp.zeros(len(v), dtype=wp.vec3i, device=DEVICE)
    wp.launch(answers, dim=len(v), inputs=[wp.array(v, dtype=wp.vec3, device=DEVICE)], outputs=[result], device=DEVICE)
    return v, result.numpy().astype(bool)


def test_all_combinations(answered):
    v, found = answered
    finite = np.isfinite(v)
    np.testing.assert_array_equal(found[:, 0], finite[:, 0])
    np.testing.assert_array_equal(found[:, 1], finite.all(axis=1))
    np.testing.assert_array_equal(found[:, 2], (finite & (v >= 0.0)).all(axis=1))
