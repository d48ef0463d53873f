"""Fresnel's equations against complex arithmetic in float64, and their limits."""

import numpy as np
import pytest

from tests.bsdf import harness, oracle
from wavefront.scene.ior import CONDUCTORS

COSINES = np.concatenate([[1e-20, 1e-7, 1e-4, 1e-3], np.linspace(0.01, 1.0, 400), [1.0 - 2.0**-24]]).astype(np.float32)
IORS = [1.0001, 1.33, 1.5, 2.419, 4.0, 0.75, 0.25]


@pytest.mark.parametrize("ior", IORS)
@pytest.mark.parametrize("side", [1.0, -1.0])
def test_dielectric_reflectance(ior, side):
    ior = float(np.float32(ior))
    n = ior if side > 0.0 else 1.0 / ior
    c = COSINES.astype(np.float64)
    p2 = n * n - 1.0 + c * c
    clear = np.abs(p2) > 1e-5  # next to the critical angle the rounding of the index decides
    result, _ = harness.fresnel(side * COSINES, ior=ior)
    np.testing.assert_allclose(result[clear, 0], oracle.fresnel(c, n)[clear], rtol=3e-5, atol=1e-12)
    cos_t = np.sqrt(np.maximum(p2, 0.0)) / n
    np.testing.assert_allclose(result[clear, 1], -side * cos_t[clear], rtol=2e-4, atol=1e-6)
    np.testing.assert_allclose(result[:, 2], n, rtol=2e-7)
    np.testing.assert_allclose(result[:, 3], 1.0 / n, rtol=2e-7)
    assert np.all(result[p2 < -1e-5, 0] == 1.0)
    assert np.all(result[p2 < -1e-5, 4] == 0.0)
    root = np.sqrt(np.maximum(p2, 0.0))
    transmittance = 2.0 * c * root * (1.0 / (c + root) ** 2 + n**2 / (n**2 * c + root) ** 2)
    np.testing.assert_allclose(result[clear, 4], transmittance[clear], rtol=1e-2 if ior < 1.001 else 5e-4)
    np.testing.assert_allclose(result[:, 0] + result[:, 4], 1.0, atol=4e-7)
    assert np.all((result[:, 0] >= 0.0) & (result[:, 0] <= 1.0))


def test_dielectric_limits():
    normal, _ = harness.fresnel([1.0, -1.0], ior=1.5)
    np.testing.assert_allclose(normal[:, 0], 0.04, rtol=1e-6)  # ((n - 1) / (n + 1))^2
    brewster, _ = harness.fresnel([1.0 / np.hypot(1.0, 1.5)], ior=1.5)
    r_s = (1.0 - 1.5**2) / (1.0 + 1.5**2)
    np.testing.assert_allclose(brewster[0, 0], 0.5 * r_s**2, rtol=1e-6)  # only s-polarised light is reflected
    grazing, _ = harness.fresnel([0.0, 1e-9], ior=1.5)
    np.testing.assert_allclose(grazing[:, 0], 1.0, rtol=1e-6)
    vanishing, _ = harness.fresnel([1.0], ior=1.0001)  # 2.5e-9, lost by subtracting nearly equal numbers
    eta = float(np.float32(1.0001))
    np.testing.assert_allclose(vanishing[0, 0], ((eta - 1.0) / (eta + 1.0)) ** 2, rtol=1e-5)


def test_no_boundary():
    c = np.array([1.0, 0.5, 1e-4, 0.0, -0.0, -0.3, -1.0], dtype=np.float32)
    result, _ = harness.fresnel(c, ior=1.0)
    np.testing.assert_array_equal(result[:, 0], 0.0)
    np.testing.assert_array_equal(result[:, 4], 1.0)
    np.testing.assert_array_equal(result[:, 1], -c)


@pytest.mark.parametrize("name", ["Au", "Al", "Cr", "a-C", "TiO2", "K", "none"])
def test_conductor_reflectance(name):
    eta, k = (np.array(v, dtype=np.float32) for v in CONDUCTORS[name])
    _, result = harness.fresnel(COSINES, eta=eta, k=k)
    n = eta.astype(np.float64) + 1j * k.astype(np.float64)
    expected = oracle.fresnel(COSINES.astype(np.float64)[:, None], n[None, :])
    np.testing.assert_allclose(result, expected, rtol=3e-6, atol=3e-7)


def test_conductor_limits():
    c = np.linspace(0.0, 1.0, 101)
    _, mirror = harness.fresnel(c, eta=(0.0, 0.0, 0.0), k=(1.0, 1e3, 1e-3))
    np.testing.assert_allclose(mirror, 1.0, rtol=1e-6)
    _, glass = harness.fresnel(c[1:], eta=(1.5, 1.0, 4.0), k=(0.0, 0.0, 0.0))
    for channel, ior in enumerate((1.5, 1.0, 4.0)):
        dielectric, _ = harness.fresnel(c[1:], ior=ior)
        np.testing.assert_allclose(glass[:, channel], dielectric[:, 0], rtol=2e-5, atol=2e-7)
    _, extreme = harness.fresnel([0.0, 1e-20, 1.0], eta=(0.0, 1e-6, 1e4), k=(0.0, 1e4, 1e4))
    assert np.all(np.isfinite(extreme))
    assert np.all((extreme >= 0.0) & (extreme <= 1.0))
    _, vacant = harness.fresnel(c, eta=(0.0, 0.0, 0.0), k=(0.0, 0.0, 0.0))  # red of AlSb: nothing can refract
    np.testing.assert_array_equal(vacant, 1.0)
