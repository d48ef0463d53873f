"""The guide of a render as the options of the command say: `guiding` is imported here, and for a guided render only."""

from __future__ import annotations

import argparse
import json
import os
from pathlib import Path

from wavefront.errors import SceneError, WavefrontError
from wavefront.guide import Guide
from wavefront.output import check_not_read, check_writable, output_paths
from wavefront.scene import Scene

NONE = "none"  # the name that turns the guide of a scene off


def add_guide_options(parser: argparse.ArgumentParser) -> None:
    """The options of a guide, as a group of their own."""
    group = parser.add_argument_group("path guiding", "Learns where light comes from; the mean image is the same.")
    group.add_argument(
        "--guide", metavar="NAME", help=f"a preset of guiding, such as npm-product; {NONE}: not that of the scene"
    )
    group.add_argument(
        "--train-share", type=float, metavar="X", help="share of the samples, or of --time, in which the guide learns"
    )
    group.add_argument("--bsdf-share", type=float, metavar="X", help="probability of BSDF sampling all the same")
    group.add_argument(
        "--guide-set", action="append", default=[], metavar="KEY=VALUE", help="change any setting, as in n_lobes=16"
    )
    group.add_argument("--save-guide", metavar="FILE", help="write what the guide has learned")
    group.add_argument(
        "--load-guide", metavar="FILE", help="begin with it; --train-share 0 uses it as it is, else it learns on"
    )


def guide_overrides(arguments: argparse.Namespace) -> list[str]:
    """`--guide` as an override of the scene's guide."""
    if arguments.guide is None:
        return []
    return [f"integrator.guide={json.dumps(None if arguments.guide == NONE else {'preset': arguments.guide})}"]


def make_guide(scene: Scene, arguments: argparse.Namespace) -> Guide | None:
    """The guide that the scene names, whose choice is changed as the options say; None if it names none.

    Raises:
        WavefrontError: An option for a guide where there is none; an unknown preset or setting, or a value that is not
            allowed.
    """
    choice, written = scene.integrator.guide, {}
    for name in ("train_share", "bsdf_share", "guide_set", "save_guide", "load_guide"):
        if choice is None and getattr(arguments, name) not in (None, []):
            option = f"--{name.replace('_', '-')}"
            raise WavefrontError(f"{option} is for a guide, and there is none; allowed: with --guide NAME")
    if choice is None:
        return None
    if arguments.train_share is not None:
        if not 0.0 <= arguments.train_share <= 1.0:
            raise WavefrontError(f"--train-share {arguments.train_share:g}; allowed: 0 to 1")
        choice.train_share = arguments.train_share
    if arguments.bsdf_share is not None:
        if not 0.0 < arguments.bsdf_share <= 1.0:
            raise WavefrontError(f"--bsdf-share {arguments.bsdf_share:g}; allowed: more than 0, up to 1")
        choice.bsdf_share = arguments.bsdf_share
    for text in arguments.guide_set:
        key, equals, value = text.partition("=")
        name = key.rpartition(".")[2]
        if not (name and equals):
            raise WavefrontError(f"--guide-set {text!r}; allowed: KEY=VALUE, such as n_lobes=16")
        for other in [other for other in choice.settings if other.rpartition(".")[2] == name]:
            del choice.settings[other]
        choice.settings[key] = _value(value)
        written[f"integrator.guide.settings.{key}"] = f"--guide-set {text}"
    if arguments.guide is not None:
        written["integrator.guide.preset"] = f"--guide {arguments.guide}"
    from guiding import guide_of

    try:
        return guide_of(scene, arguments.seed)
    except SceneError as error:
        origin = f" (set by {written[error.path]!r})" if error.path in written else ""
        raise SceneError(f"{error.message}{origin}", arguments.scene, error.path) from None


def _value(text: str) -> object:
    """A JSON value; anything that is not JSON is a string."""
    try:
        return json.loads(text, parse_constant=str)
    except (ValueError, RecursionError):
        return text


def check_guide_files(
    arguments: argparse.Namespace, scene: Scene, output: Path, resume: Path | None, checkpoint: Path | None
) -> None:
    """Refuses files of `--save-guide` and `--load-guide` that cannot be meant, before time is spent.

    Args:
        scene: As it is rendered.
        output: The image.
        resume, checkpoint: From `wavefront.render.check_checkpoints`.

    Raises:
        WavefrontError: A file that would be lost, cannot be written or is not there; or two files to begin with.
    """
    if arguments.load_guide is not None:
        if resume is not None and resume != checkpoint:
            raise WavefrontError(f"--load-guide with --resume, and {resume} holds a guide too; allowed: one of them")
        if not Path(arguments.load_guide).is_file():
            raise WavefrontError(f"{arguments.load_guide}: there is no such guide file to load")
    if arguments.save_guide is not None:
        path = Path(arguments.save_guide)
        taken = [*output_paths(output), *(file for file in (resume, checkpoint) if file)]
        if os.path.realpath(path) in map(os.path.realpath, taken):
            raise WavefrontError(f"{path}: the guide file would replace the image or a checkpoint; choose another name")
        check_not_read([path], arguments.scene, scene)
        check_writable(path)


def in_words(guide: Guide) -> str:
    """The statistics of a guide that are numbers, in one line."""
    words = [f"guide {guide.name}"]
    for name, value in guide.statistics().items():
        if isinstance(value, (int, float)) and not isinstance(value, bool):
            words.append(f"{name.replace('_', ' ')} " + (f"{value:,}" if isinstance(value, int) else f"{value:.4g}"))
    return f"{words[0]}: {', '.join(words[1:])}" if len(words) > 1 else words[0]
