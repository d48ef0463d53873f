"""The knobs that a user has: what a sweep of `tools.trade` may turn, and what each of them trades.

A knob joins by one line in `KNOBS`. Its values are swept one at a time around those of the scene, see `tools.trade`.
It says what it trades; a *bias* is a change of the expected image, and is measured against the reference of the
unrestricted scene.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable, Sequence

from guiding.registry import plain_settings
from wavefront.errors import WavefrontError
from wavefront.scene import description
from wavefront.scene.lookup import value_at

TRADES = ("time", "variance", "bias", "memory", "compile")
UNRESTRICTED_DEPTH = 64  # segments; what longer paths carry is not seen, Russian roulette apart
SPP = "spp"  # the knob that is a budget and not a change of the scene

Value = str | int | float | bool | None


@dataclasses.dataclass(frozen=True)
class Knob:
    """One knob.

    Attributes:
        name: In commands and tables.
        key: Of the scene; where its own value is read.
        values: That are swept unless the user names others; the scene's own is always among them.
        trades: Some of `TRADES`.
        override: From a value to a change of the scene; None: ``key=value``.
        least_biased: From all values of a sweep, the scene's own first, to the one that the reference has; a knob
            with a bias is measured against it.
        trains: Whether a run that learns is meant, in which fewer samples are not the beginning of more.
        on_request: It is swept only if it is named.
        of_guide: It is a setting of the guide that the scene names.
    """

    name: str
    key: str
    values: tuple[Value, ...]
    trades: tuple[str, ...]
    override: Callable[[Value], str] | None = None
    least_biased: Callable[[Sequence[Value]], Value] = lambda values: values[0]
    trains: bool = False
    on_request: bool = False
    of_guide: bool = False

    def overrides(self, value: Value) -> list[str]:
        """The changes of a scene that set this value."""
        return [self.override(value) if self.override else f"{self.key}={json.dumps(value)}"]

    def own(self, scene: description.Scene) -> Value:
        """The value that a scene has.

        Raises:
            WavefrontError: A setting of a guide, and the scene names none, or one without such a setting.
        """
        if not self.of_guide:
            return value_at(scene, self.key)
        guide = plain_settings(scene)
        if guide is None:
            example = """--override 'integrator.guide={"preset": "npm-product"}'"""
            raise WavefrontError(f"--knob {self.name}: the scene names no guide; one is chosen as by {example}")
        if self.name not in guide["settings"]:
            raise WavefrontError(f"--knob {self.name}: {guide['method']} has no such setting")
        return guide["settings"][self.name]


def _filter(value: Value) -> str:
    return f"film.filter={json.dumps({'type': value})}"


def _guide(value: Value) -> str:
    return f"integrator.guide={json.dumps(None if value is None else {'preset': value})}"


def _of_guide(name: str, values: tuple[Value, ...], trades: tuple[str, ...], key: str | None = None) -> Knob:
    key = key or f"integrator.guide.settings.{name}"
    return Knob(name, key, values, trades, trains=True, on_request=True, of_guide=True)


def _longest(depths: Sequence[Value]) -> Value:
    return max([UNRESTRICTED_DEPTH, *(depth for depth in depths if isinstance(depth, int))])


KNOBS: dict[str, Knob] = {
    knob.name: knob
    for knob in (
        Knob(SPP, "integrator.spp", (4, 8, 16, 32, 64), ("time", "variance")),
        Knob("max_depth", "integrator.max_depth", (2, 4, 8, 16), ("time", "bias", "compile"), least_biased=_longest),
        Knob("rr_depth", "integrator.rr_depth", (2, 5, 10, None), ("time", "variance", "compile")),
        Knob("nee", "integrator.nee", (True, False), ("time", "variance", "memory", "compile")),
        Knob("sampler", "integrator.sampler", ("independent", "sobol"), ("time", "variance", "compile")),
        Knob("filter", "film.filter.type", ("box", "tent", "gaussian"), ("variance", "bias", "compile"), _filter),
        Knob(
            "guide",
            "integrator.guide.preset",
            (None, "npm-radiance", "npm-product"),
            ("time", "variance", "memory", "compile"),
            _guide,
            trains=True,
            on_request=True,
        ),
        _of_guide("train_share", (0.1, 0.25, 0.5), ("time", "variance"), "integrator.guide.train_share"),
        _of_guide("n_lobes", (4, 8, 16), ("time", "variance", "memory", "compile")),
        _of_guide("n_neurons", (32, 64, 128), ("time", "variance", "memory", "compile")),
        _of_guide("precision", ("fp32", "fp16", "bf16"), ("time", "variance", "compile")),
    )
}


def find_knob(name: str) -> Knob:
    """The knob of this name.

    Raises:
        WavefrontError: There is none.
    """
    if name not in KNOBS:
        raise WavefrontError(f"there is no knob {name!r}; allowed: {', '.join(KNOBS)}")
    return KNOBS[name]


def parse_knob(text: str) -> tuple[Knob, tuple[Value, ...]]:
    """A knob and the values to sweep, from ``NAME`` or ``NAME=v1,v2``.

    Values are as in JSON (``4``, ``null``, ``false``), or words. The scene decides later what is in range.

    Raises:
        WavefrontError: No such knob, or no values, or one that is there twice.
    """
    name, equals, listed = text.partition("=")
    knob = find_knob(name.strip())
    if not equals:
        return knob, knob.values
    values = tuple(_value(word.strip()) for word in listed.split(","))
    shown = [json.dumps(value) for value in values]
    if "" in values or len(set(shown)) < len(shown):
        raise WavefrontError(f"--knob {text}: allowed: different values with commas between them")
    return knob, values


def _value(word: str) -> Value:
    try:
        value = json.loads(word)
    except ValueError:
        return word
    return word if isinstance(value, (dict, list)) else value


def label(value: Value) -> str:
    """A value as in commands and names."""
    return value if isinstance(value, str) else json.dumps(value)
