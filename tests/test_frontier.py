"""Frontiers against brute force, how often a setting is wrongly called dominated, and biases told from noise."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from tools.frontier import (
    DOMINATED,
    FALSE_ALARM_RATE,
    FRONTIER,
    OPEN,
    Setting,
    bias_figure,
    error_products,
    joined,
    pareto,
    surely_less,
    verdicts,
)
from tools.metrics import evaluate
from tools.results import Budget

few = st.integers(0, 6).map(float)  # few values, so that many are equal


@settings(deadline=None, max_examples=300)
@given(st.lists(st.tuples(few, few), min_size=0, max_size=12))
def test_pareto_against_all_pairs(points):
    def beaten(a, b):
        return b[0] <= a[0] and b[1] <= a[1] and b != a

    expected = [not any(beaten(a, b) for b in points) for a in points]
    assert pareto([p[0] for p in points], [p[1] for p in points]).tolist() == expected


def test_surely_less_is_the_paired_test():
    random = np.random.default_rng(1)
    for _ in range(200):
        n = random.integers(2, 9)
        a, b = random.normal(0.0, 1.0, n), random.normal(random.uniform(0.0, 2.0), 1.0, n)
        level = random.uniform(0.001, 0.3)
        expected = stats.ttest_rel(a, b, alternative="less").pvalue <= level
        assert surely_less(a, b, level) == expected
    assert not surely_less([1.0], [2.0], 0.5)  # one run says nothing
    assert surely_less([1.0, 2.0], [2.0, 3.0], 1e-9)  # no noise at all
    assert not surely_less([2.0, 2.0], [2.0, 2.0], 0.5)


def random_settings(random, methods: int, sizes: int, runs: int, of_seconds: bool) -> list[Setting]:
    found = []
    for method in range(methods):
        rate, noise = random.uniform(0.5, 2.0), random.uniform(0.5, 2.0)
        for k in range(sizes):
            budget = Budget(seconds=float(2**k)) if of_seconds else Budget(spp=2**k)
            seconds = 2.0**k * rate * random.normal(1.0, 0.03, runs)
            errors = noise / 2.0**k * random.normal(1.0, 0.05, runs)
            found.append(Setting(f"m{method}", budget, tuple(seconds), tuple(errors)))
    return found


@pytest.mark.parametrize("of_seconds", [False, True])
def test_verdicts_against_brute_force(of_seconds):
    """Every pair of settings, every pair of tests, without shortcuts."""
    random = np.random.default_rng(2)
    kinds = set()
    for _ in range(12):
        table = random_settings(random, random.integers(1, 6), random.integers(1, 4), 5, of_seconds)
        methods = sorted({s.method for s in table})
        level = FALSE_ALARM_RATE / (2 * max(len(methods) - 1, 1))

        def less(a, b, level=level):
            return stats.ttest_rel(a, b, alternative="less").pvalue <= level

        for setting, verdict in zip(table, verdicts(table), strict=True):
            dominating = []
            for method in methods:
                quicker = [
                    s
                    for s in table
                    if s.method == method != setting.method
                    and (less(s.seconds, setting.seconds) or (of_seconds and s.budget == setting.budget))
                ]
                largest = max(quicker, key=lambda s: s.budget.seconds or s.budget.spp, default=None)
                if largest is not None and less(largest.errors, setting.errors):
                    dominating.append(largest)
            beaten = any(
                np.mean(s.seconds) <= np.mean(setting.seconds)
                and np.mean(s.errors) <= np.mean(setting.errors)
                and s is not setting
                for s in table
            )
            assert (verdict.kind == DOMINATED) == bool(dominating)
            if dominating:
                assert verdict.by == min(dominating, key=lambda s: np.mean(s.errors)).name
            else:
                assert verdict.kind == (OPEN if beaten else FRONTIER)
            kinds.add(verdict.kind)
    assert kinds == {FRONTIER, OPEN, DOMINATED}


def worst_case(random, runs: int) -> list[Setting]:
    """A setting that nothing dominates, but that 8 other methods come as near to as they can: each has one setting of
    less time and just as much error, and one of just as much time and less error. Times vary by 5 %, errors are means
    of a skewed distribution and vary by 20 %."""

    def setting(method, spp, seconds, error):
        times = seconds * random.lognormal(0.0, 0.05, runs)
        return Setting(method, Budget(spp=spp), tuple(times), tuple(error * random.gamma(25.0, 1.0 / 25.0, runs)))

    table = [setting("it", 16, 1.0, 1.0)]
    for k in range(8):
        table += [setting(f"m{k}", 16, 0.3, 1.0), setting(f"m{k}", 64, 1.0, 0.25)]
    return table


def test_rate_of_false_alarms():
    """Of 1,000 tables in which a setting is not dominated by a hair's breadth from 16 sides, it is called so in 5 % at
    most (and four standard errors: a false alarm in 30,000 of this test), and far more at an uncorrected level."""
    random = np.random.default_rng(3)
    tables = [worst_case(random, 5) for _ in range(1000)]
    rate = np.mean([verdicts(table)[0].kind == DOMINATED for table in tables])
    print(f"false alarms: {100.0 * rate:.2f} %")
    assert rate <= FALSE_ALARM_RATE + 4.0 * np.sqrt(FALSE_ALARM_RATE * (1.0 - FALSE_ALARM_RATE) / len(tables))
    uncorrected = np.mean([verdicts(table, FALSE_ALARM_RATE * 16)[0].kind == DOMINATED for table in tables[:300]])
    assert uncorrected > 0.15


def test_finds_what_is_dominated():
    """A method with half the error at 90 % of the time, among 8 others, in at least 90 of 100 tables of 5 runs."""
    random = np.random.default_rng(4)
    found = 0
    for _ in range(100):
        table = random_settings(random, 8, 3, 5, False)
        seconds, errors = random.normal(1.0, 0.01, (2, 5)), random.normal(1.0, 0.05, (2, 5))
        table.append(Setting("good", Budget(spp=64), tuple(0.9 * seconds[0]), tuple(0.5 * errors[0])))
        table.append(Setting("bad", Budget(spp=64), tuple(seconds[1]), tuple(errors[1])))
        found += verdicts(table)[-1].kind == DOMINATED
    assert found >= 90


def test_scenes_are_joined_by_geometric_means():
    budget = Budget(spp=4)
    one = [Setting("a", budget, (1.0, 4.0), (0.1, 0.4)), Setting("b", budget, (3.0, 3.0), (1.0, 1.0))]
    two = [Setting("b", budget, (12.0, 3.0), (4.0, 9.0)), Setting("a", budget, (4.0, 9.0), (0.4, 0.1))]
    one.append(Setting("c", budget, (1.0, 1.0), (1.0, 1.0)))  # not in the other
    a, b = joined([one, two])
    assert (a.method, b.method) == ("a", "b")
    np.testing.assert_allclose(a.seconds, (2.0, 6.0))
    np.testing.assert_allclose(a.errors, (0.2, 0.2))
    np.testing.assert_allclose(b.seconds, (6.0, 3.0))
    np.testing.assert_allclose(b.errors, (2.0, 3.0))


# --- bias --------------------------------------------------------------------------------------------------------


def test_products_of_errors_by_hand():
    """Two pixels of one row; d = (1, 1, 1 | 0, 0, 0) and (2, 2, 2 | 3, 3, 3)."""
    reference = np.full((1, 2, 3), 2.0)
    reference[0, 1] = 1.0
    images = [reference + np.array([[[1.0], [0.0]]]), reference + np.array([[[2.0], [3.0]]])]
    np.testing.assert_allclose(error_products(images, reference, "mse"), [[0.5, 1.0], [1.0, 6.5]])
    w = 1.0 / (4.0 + 0.01), 1.0 / (1.0 + 0.01)
    expected = [[w[0] / 2, w[0]], [w[0], (4 * w[0] + 9 * w[1]) / 2]]
    np.testing.assert_allclose(error_products(images, reference, "relmse"), expected)


@pytest.mark.parametrize("metric", ["mse", "relmse", "mrse"])
def test_products_have_the_errors_on_their_diagonal(metric):
    random = np.random.default_rng(5)
    reference, images = random.uniform(0.0, 2.0, (4, 5, 3)), random.uniform(0.0, 2.0, (3, 4, 5, 3))
    products = error_products(images, reference, metric)
    np.testing.assert_allclose(np.diag(products), [evaluate(metric, image, reference) for image in images])
    np.testing.assert_allclose(products, products.T)


def test_jackknife_by_hand():
    """Against leaving out one run after the other."""
    random = np.random.default_rng(6)
    products, control = (
        error_products(random.normal(0.0, 1.0, (4, 5, 5, 3)), np.zeros((5, 5, 3)), "mse") for _ in "ab"
    )

    def pairs(matrix, runs):
        return np.mean([matrix[i, j] for i in runs for j in runs if i != j])

    def pseudo(matrix):
        without = [[j for j in range(4) if j != i] for i in range(4)]
        return np.array([4 * pairs(matrix, range(4)) - 3 * pairs(matrix, rest) for rest in without])

    values = pseudo(products) - pseudo(control)
    figure = bias_figure(products, control)
    assert figure.mean == pytest.approx(pairs(products, range(4)) - pairs(control, range(4)), abs=1e-12)
    half = 3.182446 * values.std(ddof=1) / 2.0  # t(0.975; 3)
    assert figure.high - figure.mean == pytest.approx(half, rel=1e-6)
    assert bias_figure(products[:2, :2], control[:2, :2]) is None


@pytest.mark.parametrize("bias", [0.0, 0.4])
def test_bias_is_told_from_noise(bias):
    """Of 400 sweeps with 5 runs of 20x20 pixels, whose noise is far above the bias and skewed, and whose reference has
    noise too: the mean is right within 4 standard errors; at least 95 % of intervals cover the truth, less 4 standard
    errors (the jackknife is cautious where there is nothing but noise). False alarm rate 1e-4."""
    random, shape, figures = np.random.default_rng(7), (20, 20, 3), []
    truth = np.where(np.arange(20)[:, None, None] < 10, bias, -0.5 * bias)
    for _ in range(400):
        reference = 1.0 + 0.2 * random.standard_normal(shape)
        noise = random.gamma(1.0, 1.0, (2, 5, *shape)) - 1.0
        products = [error_products(images, reference, "mse") for images in (1.0 + truth + noise[0], 1.0 + noise[1])]
        figures.append(bias_figure(*products))
    expected = float(np.mean(truth**2 * np.ones(shape)))
    means = np.array([figure.mean for figure in figures])
    assert abs(means.mean() - expected) < 4.0 * means.std() / np.sqrt(len(means))
    covered = np.mean([figure.low <= expected <= figure.high for figure in figures])
    print(f"covered: {100.0 * covered:.1f} %")
    assert covered > 0.95 - 4.0 * np.sqrt(0.95 * 0.05 / len(figures))
    if bias:
        assert np.mean([figure.low > 0.0 for figure in figures]) > 0.5
