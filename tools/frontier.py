"""Which settings are worth choosing: the Pareto frontier of time against error, and what can be said for sure.

A *setting* is a method with a budget, measured in several runs. It is on the frontier if no other setting has both less
mean time and less mean error. A setting off the frontier is *dominated* only where the runs allow to say so:

    Setting B is dominated by a method M if some setting A of M takes less time than B, and has less error, each by a
    one-sided paired t-test over the seeds at the level alpha / (2 m), m being the number of other methods. A is the
    setting of M with the largest budget among those that take less time by that test; settings of one budget in
    seconds take the same time, and the error alone decides.

If B is not dominated, it is called so with a probability of at most alpha = 0.05 (as far as means of runs are normal):
of the settings of M, whose errors fall with their budgets, those that do take less time have no less error than B, and
the test of error finds less at its level; and for one that takes no less time, the test of time must err. Two errors
for each of m methods. In most cases both criteria differ by far, and the rate is much lower. All else is *not
separated*.

The *bias* of a method is told apart from its noise by independent runs: with d_i = I_i - R of run i, the mean of w d_i
d_j over pixels, channels and pairs of different runs has the expectation w (bias^2 + noise of the reference^2), because
the noise of different runs does not correlate; w is the metric's weight, 1 / (R^2 + epsilon) for relMSE. The noise of
the reference is in the same figure of a method that makes the reference's own image (the *control*), so the difference
is the part of the error that no number of samples removes. Its interval is that of the jackknife over the runs.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Sequence

import numpy as np

from tools.bench_common import require_scipy
from tools.metrics import MRSE_EPSILON, RELMSE_EPSILON
from tools.results import Budget
from tools.summary import Figure, mean_figure

FALSE_ALARM_RATE = 0.05  # of calling one setting dominated that is not
FRONTIER, DOMINATED, OPEN = "frontier", "dominated", "not separated"
SQUARES = {"mse": None, "relmse": RELMSE_EPSILON, "mrse": MRSE_EPSILON}  # metrics of which a bias is told, and epsilon


@dataclasses.dataclass(frozen=True)
class Setting:
    """A method with a budget, and what its runs took and gave, in the order of the seeds.

    Attributes:
        method: Its name.
        budget: Samples per pixel, or seconds.
        seconds: Of rendering.
        errors: Of the images.
    """

    method: str
    budget: Budget
    seconds: tuple[float, ...]
    errors: tuple[float, ...]

    @property
    def name(self) -> str:
        return f"{self.method}, {self.budget.label}"

    @property
    def size(self) -> float:
        """Of the budget."""
        return self.budget.spp if self.budget.seconds is None else self.budget.seconds


@dataclasses.dataclass(frozen=True)
class Verdict:
    """On a setting: `FRONTIER`, `DOMINATED` or `OPEN`, and the name of a setting that dominates it."""

    kind: str
    by: str | None = None


def pareto(seconds: Sequence[float], errors: Sequence[float]) -> np.ndarray:
    """Which points no other point beats: none has no more of both, and less of one. O(n log n).

    Returns:
        Shape [n], bool.
    """
    seconds, errors = np.asarray(seconds, float), np.asarray(errors, float)
    best, kept = math.inf, np.zeros(len(seconds), bool)
    order = np.lexsort((errors, seconds))
    at = 0
    while at < len(order):  # points of one time together
        end = at
        while end < len(order) and seconds[order[end]] == seconds[order[at]]:
            end += 1
        least = errors[order[at]]
        if least < best:
            kept[[i for i in order[at:end] if errors[i] == least]] = True
            best = least
        at = end
    return kept


def surely_less(a: Sequence[float], b: Sequence[float], level: float) -> bool:
    """Whether the mean of `a` is less than that of `b` by a one-sided paired t-test; never with one run."""
    difference = np.subtract(b, a)
    n, mean = len(difference), float(np.mean(difference))
    if n < 2 or not mean > 0.0:
        return False
    return mean >= _student(level, n - 1) * float(difference.std(ddof=1)) / math.sqrt(n)


@functools.lru_cache
def _student(level: float, degrees: int) -> float:
    """What Student's t exceeds with this probability."""
    return float(require_scipy().t.isf(level, degrees))


def faster(a: Setting, b: Setting, level: float) -> bool:
    """Whether `a` surely takes no more time than `b`."""
    if a.budget.seconds is not None and a.budget == b.budget:
        return True
    return surely_less(a.seconds, b.seconds, level)


def find_dominating(setting: Setting, others: Sequence[Setting], level: float) -> Setting | None:
    """A setting of one other method that dominates, at this level of each test."""
    for other in sorted(others, key=lambda other: other.size, reverse=True):
        if faster(other, setting, level):
            return other if surely_less(other.errors, setting.errors, level) else None
    return None


def verdicts(settings: Sequence[Setting], false_alarm_rate: float = FALSE_ALARM_RATE) -> list[Verdict]:
    """What can be said of each setting beside the others, see the head of this module."""
    methods: dict[str, list[Setting]] = {}
    for setting in settings:
        methods.setdefault(setting.method, []).append(setting)
    level = false_alarm_rate / (2 * max(len(methods) - 1, 1))
    kept = pareto([np.mean(s.seconds) for s in settings], [np.mean(s.errors) for s in settings])
    found = []
    for setting, on_frontier in zip(settings, kept, strict=True):
        dominating = [
            other
            for method, others in methods.items()
            if method != setting.method and (other := find_dominating(setting, others, level)) is not None
        ]
        if dominating:
            found.append(Verdict(DOMINATED, min(dominating, key=lambda other: np.mean(other.errors)).name))
        else:
            found.append(Verdict(FRONTIER if on_frontier else OPEN))
    return found


def joined(scenes: Sequence[Sequence[Setting]]) -> list[Setting]:
    """The settings of several scenes as one: times and errors are geometric means over the scenes, seed by seed.

    Args:
        scenes: Of each, its settings; those that not all have are left out.
    """
    by_key = [{(setting.method, setting.budget): setting for setting in settings} for settings in scenes]

    def mean(values: Sequence[Sequence[float]]) -> tuple[float, ...]:
        return tuple(np.exp(np.log(np.asarray(values)).mean(axis=0)).tolist())

    return [
        Setting(
            *key,
            mean([settings[key].seconds for settings in by_key]),
            mean([settings[key].errors for settings in by_key]),
        )
        for key in by_key[0]
        if all(key in settings for settings in by_key)
    ]


# --- bias --------------------------------------------------------------------------------------------------------


def error_products(images: Sequence[np.ndarray], reference: np.ndarray, metric: str) -> np.ndarray:
    """The mean over pixels and channels of w d_i d_j, for all pairs of runs.

    Args:
        images: One per run, [height, width, 3].
        reference: The same.
        metric: One of `SQUARES`.

    Returns:
        Shape [runs, runs]; the diagonal has the errors of the runs.
    """
    reference = np.asarray(reference, np.float64)
    weight = np.ones_like(reference)
    if SQUARES[metric] is not None:
        weight = 1.0 / (reference**2 + SQUARES[metric])
    d = np.stack([((image - reference) * np.sqrt(weight)).ravel() for image in images])
    return d @ d.T / reference.size


def _pseudo_values(products: np.ndarray) -> np.ndarray:
    """Of the jackknife of the mean over pairs of different runs; their mean is that mean."""
    n = len(products)
    pairs = products.sum() - np.trace(products)
    without = pairs - 2.0 * (products.sum(axis=0) - np.diag(products))
    return n * pairs / (n * (n - 1)) - (n - 1) * without / ((n - 1) * (n - 2))


def bias_figure(products: np.ndarray, control: np.ndarray) -> Figure | None:
    """The part of an error that is bias, with its interval; None with fewer than three runs.

    Args:
        products: `error_products` of the method.
        control: Of as many runs of a method that makes the reference's own image.
    """
    if len(products) < 3:
        return None
    return mean_figure(_pseudo_values(products) - _pseudo_values(control))
