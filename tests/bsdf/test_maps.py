"""Bump and normal maps: the frames against geometry, and values, densities and samples against Mitsuba 3."""

import itertools

import numpy as np
import pytest

from tests.bsdf import harness
from tests.bsdf.materials import Materials, vertices
from tests.chi_square import cell_sums, histogram, nodes, p_value, sidak
from wavefront.scene import description as d
from wavefront.scene.images import write_exr

N = 4000
DIFFUSE = d.Diffuse(reflectance=[0.9, 0.5, 0.1])
METAL = d.RoughConductor(eta=[0.2, 0.9, 1.1], k=[3.9, 2.4, 2.2], alpha_u=0.5, alpha_v=0.2)
GLASS = d.RoughDielectric(int_ior=1.5, ext_ior=1.0, alpha_u=0.3, alpha_v=0.6)
INNER = {"diffuse": DIFFUSE, "metal": METAL, "glass": GLASS, "two sides": d.TwoSided(front=METAL, back=DIFFUSE)}


def coded(n):
    """A normal as the colour of a normal map."""
    return [float(x) for x in 0.5 * (unit(n) + 1.0)]


def unit(v):
    v = np.asarray(v, np.float64)
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def turned(seed: int):
    """Random orthonormal s, t, n, and a vertex in that frame with a random dp/du and dp/dv."""
    rng = np.random.default_rng(seed)
    q, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    s, t = q[0], q[1]
    a, b, c = rng.uniform(0.5, 2.0), rng.normal(), rng.choice([-1.0, 1.0]) * rng.uniform(0.5, 2.0)
    return s, t, np.cross(s, t), (a, b, c)


def directions(seed, n=N):
    return harness.random_directions(n, seed), harness.random_directions(n, seed + 1)


@pytest.fixture(scope="module")
def height_file(tmp_path_factory):
    """Heights without any symmetry, of all slopes."""
    path = tmp_path_factory.mktemp("maps") / "height.exr"
    y, x = np.mgrid[0:8, 0:16] / 8.0
    write_exr(path, {"Y": (0.3 * np.sin(5.0 * x + 1.0) * np.cos(4.0 * y) + 0.2 * x * y).astype(np.float32)})
    return str(path)


# --- against geometry --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("inner", INNER)
def test_a_flat_normal_map_changes_nothing(inner):
    m = Materials(INNER[inner], d.NormalMap(bsdf=INNER[inner], normal=[0.5, 0.5, 1.0]))
    wo, wi = directions(1)
    u = harness.uniforms(N, 2)
    plain, mapped = (m.run(i, wo, wi, u) for i in (0, 1))
    for a, b in zip(plain[1:], mapped[1:], strict=True):
        for field in a.dtype.names:
            np.testing.assert_allclose(a[field], b[field], rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("inner", ["diffuse", "metal", "glass"])
def test_a_tilted_normal_map_is_a_tilted_surface(inner):
    """But for the light between the two horizons, of which there is none."""
    normal = unit([0.3, -0.2, 0.9])
    m = Materials(INNER[inner], d.NormalMap(bsdf=INNER[inner], normal=coded(normal), shadowing=False))
    s, t, n, _ = turned(3)
    wo, wi = directions(3)
    u = harness.uniforms(N, 4)
    tilted_n = normal @ np.array([s, t, n])
    tilted_s = unit(s - (s @ tilted_n) * tilted_n)
    seen = (wo @ n) * (wo @ tilted_n) > 0.0  # others see the normal turned back
    frames, e, sample = m.run(1, wo, wi, u, vertices(N, s=s, t=t))
    _, expected, expected_sample = m.run(0, wo, wi, u, vertices(N, s=tilted_s, t=np.cross(tilted_n, tilted_s)))
    np.testing.assert_allclose(frames["normal"][seen], np.broadcast_to(tilted_n, (seen.sum(), 3)), atol=1e-6)
    np.testing.assert_allclose(frames["base_normal"], np.broadcast_to(n, (N, 3)), atol=1e-6)
    between = (wi @ n) * (wi @ tilted_n) <= 0.0
    assert 100 < (between & seen).sum() < 0.5 * N
    assert np.all(e["pdf"][between & seen] == 0.0)
    same = seen & ~between
    for field in ("value", "pdf"):
        np.testing.assert_allclose(e[field][same], expected[field][same], rtol=2e-4, atol=1e-6)
    alive = seen & (expected_sample["weight"][:, 0] > 0.0)
    lost = (expected_sample["wi"] @ n) * (expected_sample["wi"] @ tilted_n) <= 0.0
    assert (alive & lost).any()
    assert np.all(sample["weight"][alive & lost] == 0.0)
    kept = alive & ~lost & (np.abs(sample["wi"] @ n) > 1e-5)
    for field in ("wi", "weight", "pdf", "eta"):
        np.testing.assert_allclose(sample[field][kept], expected_sample[field][kept], rtol=1e-3, atol=1e-5)


@pytest.mark.parametrize("seed", range(4))
def test_a_ramp_is_an_inclined_plane(seed, tmp_path):
    """The height h = p u + q v along n turns the plane dp/du, dp/dv into that of dp/du + p n, dp/dv + q n."""
    s, t, n, (a, b, c) = turned(seed)
    p, q = np.random.default_rng(seed).normal(size=2)
    y, x = np.mgrid[0:4, 0:8]
    write_exr(tmp_path / "ramp.exr", {"Y": (p * (x + 0.5) / 8 + q * (y + 0.5) / 4).astype(np.float32)})
    bump = d.BumpMap(bsdf=DIFFUSE, height=d.Bitmap(file=str(tmp_path / "ramp.exr")), scale=0.7)
    at = vertices(1, (0.52, 0.41), s, t, (a, b, c))
    slope = np.cross(a * s + 0.7 * p * n, b * s + c * t + 0.7 * q * n)
    expected = unit(slope * np.sign(slope @ n))
    frames, _, _ = Materials(bump).run(0, [n + 0.01 * expected], None, np.zeros((1, 3)), at)
    np.testing.assert_allclose(frames["normal"][0], expected, atol=2e-5)
    np.testing.assert_allclose(frames["tangent"][0] @ expected, 0.0, atol=1e-6)
    assert frames["tangent"][0] @ s > 0.0


def test_a_bump_map_without_uvs_changes_nothing(height_file):
    bump = d.BumpMap(bsdf=DIFFUSE, height=d.Bitmap(file=height_file))
    for jacobian in ((1.0, 0.0, 0.0), (0.0, 0.0, 0.0), (1.0, np.inf, np.inf), (np.inf, np.nan, np.inf)):
        frames, _, _ = Materials(bump).run(0, [[0, 0, 1]], None, np.zeros((1, 3)), vertices(1, jacobian=jacobian))
        np.testing.assert_array_equal(frames["normal"], [[0, 0, 1]])


def test_black_and_white_normals_are_survived():
    """No length, or straight along the tangent."""
    for normal in ([0.5, 0.5, 0.5], [1.0, 0.5, 0.5], [0.0, 0.5, 0.5], [0.5, 0.5, 0.0]):
        m = Materials(d.NormalMap(bsdf=METAL, normal=normal))
        frames, e, sample = m.run(0, *directions(6), harness.uniforms(N, 6))
        for array in (frames["normal"], frames["tangent"], e["value"], e["pdf"], sample["weight"], sample["wi"]):
            assert np.isfinite(array).all()
        np.testing.assert_allclose(np.einsum("ij,ij->i", frames["normal"], frames["tangent"]), 0.0, atol=1e-6)


@pytest.mark.parametrize("inner", ["metal", "glass"])
def test_samples_follow_the_pdf(inner):
    """Chi-square over the sphere, the share of samples that are lost between the horizons included."""
    m = Materials(d.NormalMap(bsdf=INNER[inner], normal=coded([0.5, -0.3, 0.8])))
    shape, per_cell, count = (31, 17), 12, 200_000
    cosines = (0.8, 0.2) if inner == "metal" else (0.8, 0.2, -0.6)
    for seed, cos_o in enumerate(cosines):
        wo = harness.direction(cos_o)
        x, y, area = nodes(shape, per_cell)
        z = 2.0 * x - 1.0
        r = np.sqrt(1.0 - z * z)
        grid = np.stack([r * np.cos(2.0 * np.pi * y), r * np.sin(2.0 * np.pi * y), z], axis=1)
        probabilities = cell_sums(m.evaluate(0, wo, grid)["pdf"] * 4.0 * np.pi * area, shape, per_cell)
        s = m.sample(0, wo, harness.uniforms(count, seed))
        alive = s["weight"][:, 0] > 0.0
        w = s["wi"][alive].astype(np.float64)
        counts = histogram(0.5 * (w[:, 2] + 1.0), np.mod(np.arctan2(w[:, 1], w[:, 0]) / (2.0 * np.pi), 1.0), shape)
        level = sidak(2 * len(cosines))
        assert p_value(counts, probabilities / probabilities.sum()) > level, cos_o
        share = probabilities.sum()
        assert abs(alive.mean() - share) < 4.5 * np.sqrt(share * (1.0 - share) / count) + 2e-3, cos_o
        e = m.evaluate(0, wo, w)
        np.testing.assert_allclose(s["pdf"][alive], e["pdf"], rtol=2e-3)
        np.testing.assert_allclose(s["weight"][alive] * s["pdf"][alive, None], e["value"], rtol=2e-3, atol=1e-7)


# --- against Mitsuba ---------------------------------------------------------------------------------------------

mi = pytest.importorskip("mitsuba")
mi.set_variant("scalar_rgb")
mi.set_log_level(mi.LogLevel.Error)
PAIRS = 700


def as_dict(bsdf):
    """Mitsuba's dictionary of the BSDFs above."""

    def rgb(value):
        return {"type": "rgb", "value": value}

    if isinstance(bsdf, d.Diffuse):
        return {"type": "diffuse", "reflectance": rgb(bsdf.reflectance)}
    if isinstance(bsdf, d.TwoSided):
        return {"type": "twosided", "front": as_dict(bsdf.front), "back": as_dict(bsdf.back or bsdf.front)}
    rough = {"alpha_u": bsdf.alpha_u, "alpha_v": bsdf.alpha_v, "distribution": bsdf.distribution}
    if isinstance(bsdf, d.RoughConductor):
        return {"type": "roughconductor", "eta": rgb(bsdf.eta), "k": rgb(bsdf.k), **rough}
    return {"type": "roughdielectric", "int_ior": bsdf.int_ior, "ext_ior": bsdf.ext_ior, **rough}


def interaction(s, t, n, jacobian, uv):
    a, b, c = jacobian
    si = mi.SurfaceInteraction3f()
    si.n, si.uv = n.tolist(), uv
    si.sh_frame = mi.Frame3f(s.tolist(), t.tolist(), n.tolist())
    si.dp_du, si.dp_dv = (a * s).tolist(), (b * s + c * t).tolist()
    return si


NORMAL = [0.6, 0.4, 0.85]
CASES = list(itertools.product(["normal", "bump"], [*INNER, "inside"], [True, False], [True, False]))


@pytest.mark.parametrize(("kind", "inner", "flip", "shadowing"), CASES)
def test_against_mitsuba(kind, inner, flip, shadowing, height_file):
    """In a random frame where Mitsuba can; `inside` has the map inside of the two-sided BSDF."""
    settings = {"flip_invalid_normals": flip, "shadowing": shadowing}
    theirs = {"flip_invalid_normals": flip, "use_shadowing_function": shadowing}
    if kind == "normal":
        theirs |= {"type": "normalmap", "normalmap": {"type": "rgb", "value": NORMAL}}
    else:
        theirs |= {"type": "bumpmap", "height": {"type": "bitmap", "raw": True, "filename": height_file}, "scale": 1.5}

    def mapped(bsdf):
        if kind == "normal":
            return d.NormalMap(bsdf=bsdf, normal=NORMAL, **settings)
        return d.BumpMap(bsdf=bsdf, height=d.Bitmap(file=height_file), scale=1.5, **settings)

    if inner == "inside":
        ours = d.TwoSided(front=mapped(METAL), back=mapped(DIFFUSE))
        theirs = {
            "type": "twosided", "front": theirs | {"nested": as_dict(METAL)},
            "back": theirs | {"nested": as_dict(DIFFUSE)},
        }  # fmt: skip
    else:
        ours, theirs = mapped(INNER[inner]), theirs | {"nested": as_dict(INNER[inner])}
    m, bsdf, context = Materials(ours), mi.load_dict(theirs), mi.BSDFContext()
    wo, wi = directions(11, PAIRS)
    u = harness.uniforms(PAIRS, 13)
    rng = np.random.default_rng(5)
    s, t, n, jacobian = turned(17)
    if kind == "bump":  # Mitsuba 3.9 makes its tangent of dp/du in world space and the normal in the frame's own
        s, t, n = np.eye(3)
    uv = rng.random((PAIRS, 2)).astype(np.float32)
    _, e, sample = m.run(0, wo, wi, u, vertices(PAIRS, uv, s, t, jacobian))
    frame = np.array([s, t, n])
    lit, drawn = 0, 0
    for i in range(PAIRS):
        local_o, local_i = frame @ wo[i], frame @ wi[i]
        if min(abs(local_o[2]), abs(local_i[2])) < 0.02:  # each renderer has roundings of its own there
            continue
        si = interaction(s, t, n, jacobian, uv[i].tolist())
        si.wi = local_o.tolist()
        value = np.array(bsdf.eval(context, si, local_i.tolist()))
        np.testing.assert_allclose(e["value"][i], value, rtol=1e-3, atol=1e-5)
        np.testing.assert_allclose(e["pdf"][i], bsdf.pdf(context, si, local_i.tolist()), rtol=1e-3, atol=1e-5)
        lit += value.any()
        # Mitsuba chooses the lobe by its own number, and samples visible normals in its own way: what it says of our
        # direction counts.
        w = frame @ sample["wi"][i].astype(np.float64)
        if sample["weight"][i].any() and abs(w[2]) > 0.02:
            value, pdf = np.array(bsdf.eval(context, si, w.tolist())), bsdf.pdf(context, si, w.tolist())
            np.testing.assert_allclose(sample["pdf"][i], pdf, rtol=3e-3, atol=1e-5)
            np.testing.assert_allclose(sample["weight"][i], value / pdf, rtol=3e-3, atol=1e-5)
            drawn += 1
    assert lit > 0.1 * PAIRS
    assert drawn > 0.2 * PAIRS
