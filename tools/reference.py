"""References: the image of a scene with its variance, rendered until its error is small, and an account of its making.

    python -m tools.reference SCENE [--override integrator.max_depth=8 …] [--error E] [--spp N] [--seconds S]

renders until the first of the limits is reached (none given: `--error 0.01`) and writes, in the folder `--output`,
``NAME-HASH.wavefront.exr`` with the channels R, G, B and variance.Y (the estimated variance of the mean luminance of
each pixel), and the same name with ``.json``: settings, seed, versions, samples, seconds, error. The *relative standard
error* E is the root of the mean over pixels of variance.Y / (Y^2 + 0.01). E^2 is what the reference itself has of
relMSE (of luminance) in the mean, and so what it adds to the relMSE that is measured with it.

With `--with mitsuba`, Mitsuba 3 renders it, an independent renderer: ``NAME-HASH.mitsuba.exr``, the variance from the
spread of batches with seeds of their own. When both exist they are compared (see `tools.bias_test`; exit status 1 if
they differ), and ``NAME-HASH.comparison.json`` says how.

HASH is of all that the expected image depends on: the scene with its files, film, depth. Next-event estimation, Russian
roulette and the sampler change the noise alone, and are no part of it. A reference that is there is used if it is good
enough; for stricter limits it is continued. A render that is killed goes on from its last checkpoint when the command
is repeated.
"""

from __future__ import annotations

import argparse
import dataclasses
import datetime
import hashlib
import json
import os
import sys
from collections.abc import Sequence
from pathlib import Path

import msgspec
from rich.console import Console

from tools.bench_common import machine, require_scipy
from tools.image_reader import read_image
from tools.methods import RENDERERS, Job, load_job, scene_name
from tools.reference_render import MAKERS, Goal, median_relative_error, relative_error, render
from tools.reference_store import (
    DEFAULT_FOLDER,
    FORMAT,
    Account,
    Reference,
    account_path,
    find_reference,
    load_reference,
    plain,
    read_account,
    reference_path,
    target_records,
)
from wavefront.errors import WavefrontError
from wavefront.identity import explain_differences, scene_hash
from wavefront.output import check_writable
from wavefront.scene.images import replacing

DEFAULT_ERROR = 0.01
RATIO_TOLERANCE = 0.005  # the 95 % interval of the ratio of the means of two references must meet 1 ± this
NOISY = 0.02  # width of an interval that says nothing

__all__ = ["Account", "Reference", "find_reference", "load_reference", "make_reference", "target_records"]


# --- making ------------------------------------------------------------------------------------------------------


def make_reference(
    job: Job,
    goal: Goal,
    folder: Path,
    renderer: str = "wavefront",
    seed: int = 0,
    every: float = 60.0,
    console: Console | None = None,
    exact: bool = True,
) -> Reference:
    """The reference of a job: the one that is there if it is good enough; else it is rendered, or continued.

    Args:
        job: What to render.
        goal: When to stop.
        folder: Of references; made if missing.
        renderer: A key of `RENDERERS`.
        seed: Of the random numbers.
        every: Seconds between checkpoints.
        console: For progress; None: none.
        exact: Whether one that is there must have this seed and these settings of the noise too; else it is used
            whatever they are, if it is good enough.

    Raises:
        WavefrontError: A renderer that cannot render the job, a reference that was made otherwise (another seed, say),
            or a file that cannot be written.
        KeyboardInterrupt: After Ctrl-C or SIGTERM, when the checkpoint is written.
    """
    if renderer not in MAKERS:
        raise WavefrontError(f"unknown renderer {renderer!r} of references; allowed: {', '.join(MAKERS)}")
    RENDERERS[renderer].check(job)
    if job.scene.integrator.sampler != "independent":
        sampler = job.scene.integrator.sampler
        raise WavefrontError(
            f"integrator.sampler is {sampler!r}; a reference takes independent ones: their variance is known"
        )
    target = target_records(job.scene)
    path = reference_path(folder, scene_name(job.path), scene_hash(target), renderer)
    settings = plain(
        {
            "film": msgspec.to_builtins(msgspec.structs.asdict(job.scene.film)),
            "integrator": msgspec.to_builtins(msgspec.structs.asdict(job.scene.integrator)),
        }
    )
    settings["integrator"].pop("spp", None)
    settings["film"].pop("aovs", None)
    if path.exists() and account_path(path).exists():
        there = _reuse(path, goal, {"seed": seed, "settings": settings}, exact)
        if there is not None:
            return there
    folder.mkdir(parents=True, exist_ok=True)
    check_writable(path)
    maker = MAKERS[renderer](job, seed)
    render(maker, goal, path.with_suffix(".checkpoint"), every, console)
    image, variance = maker.estimate()
    error = relative_error(image, variance)
    maker.write(path)
    account = Account(
        format=FORMAT,
        image=path.name,
        image_sha256=hashlib.sha256(path.read_bytes()).hexdigest(),
        scene=scene_name(job.path),
        file=str(job.path),
        overrides=list(job.overrides),
        parameters=dict(job.parameters),
        renderer=renderer,
        versions=RENDERERS[renderer].versions(job.device),
        seed=seed,
        settings=settings,
        target=plain(target),
        target_sha256=scene_hash(target),
        samples_per_pixel=maker.samples,
        seconds=maker.seconds,
        error=error,
        median_error=median_relative_error(image, variance),
        requested=dataclasses.asdict(goal),
        reached=None if goal.error is None else error <= goal.error,
        details=maker.details(),
        machine=machine(),
        date=datetime.datetime.now(datetime.timezone.utc).isoformat(timespec="seconds"),
    )
    with replacing(account_path(path)) as temporary:
        temporary.write_bytes(msgspec.json.format(msgspec.json.encode(account), indent=2) + b"\n")
    return load_reference(path, job.scene)


def _reuse(path: Path, goal: Goal, made: dict, exact: bool) -> Reference | None:
    """The reference at `path` if it is good enough, None if it is to be continued.

    Raises:
        WavefrontError: It was made otherwise.
    """
    account = read_account(path)
    differs = explain_differences(made, {"seed": account.seed, "settings": account.settings}, path.name)
    enough = goal.reached(account.samples_per_pixel, account.seconds, account.error)
    if differs and (exact or not enough):
        raise WavefrontError(f"{path}: is there, made otherwise: {differs}; choose another folder or remove it")
    try:
        return load_reference(path) if enough else None
    except WavefrontError:  # killed between its image and its account; the checkpoint has the samples
        return None


# --- two renderers -----------------------------------------------------------------------------------------------


def compare_references(a: Path, b: Path):
    """Tests whether two references are of one image, see `tools.bias_test`.

    Returns:
        The `BiasTest` of `a` against `b`, and the verdict: ``differs`` if a tile does at the false alarm rate of the
        test, or if the 95 % interval of the ratio of means does not meet 1 ± 0.005; else ``noisy`` if that is wider
        than 0.02, or ``same``.

    Raises:
        WavefrontError: An image cannot be read, or scipy is not installed.
    """
    require_scipy()
    from tools.bias_test import find_bias  # only here: it needs scipy

    test = find_bias(read_image(a), read_image(b))
    low, high = test.ratio()[1] if test.ratio() else (1.0, 1.0)  # of black images
    if test.failing_tiles or low > 1.0 + RATIO_TOLERANCE or high < 1.0 - RATIO_TOLERANCE:
        return test, "differs"
    return test, "noisy" if high - low > NOISY else "same"


def compare_stored(reference: Reference) -> list[dict]:
    """Compares a reference with those of other renderers beside it, and writes the outcome there.

    Returns:
        For each other one: ``images``, ``image_sha256``, ``samples_per_pixel``, ``verdict``, and `BiasTest.figures`.
    """
    account, folder, outcomes = reference.account, reference.path.parent, []
    for renderer in RENDERERS:
        other = reference_path(folder, account.scene, account.target_sha256, renderer)
        if renderer == account.renderer or not other.exists():
            continue
        # Always in the order of the list, whichever was made last.
        pair = sorted((reference, load_reference(other)), key=lambda one: [*RENDERERS].index(one.account.renderer))
        test, verdict = compare_references(*(one.path for one in pair))
        outcomes.append(
            {
                "images": [one.path.name for one in pair],
                "image_sha256": [one.account.image_sha256 for one in pair],
                "samples_per_pixel": [one.account.samples_per_pixel for one in pair],
                "verdict": verdict,
                **test.figures(),
            }
        )
    if outcomes:
        with replacing(folder / f"{account.scene}-{account.target_sha256[:12]}.comparison.json") as temporary:
            temporary.write_text(json.dumps(outcomes, indent=2) + "\n", encoding="utf-8")
    return outcomes


def in_words(outcome: dict) -> str:
    """A comparison in one line."""
    first, second = outcome["images"]
    rows, columns = outcome["tiles"]
    verdict = "too noisy to be compared" if outcome["verdict"] == "noisy" else outcome["verdict"]
    text = f"{verdict}: {first} against {second}: "
    if outcome["ratio_of_means"] is not None:
        low, high = outcome["ratio_interval_95"]
        text += f"ratio of means {outcome['ratio_of_means']:.4f}, 95 % interval {low:.4f} to {high:.4f}; "
    return text + (
        f"{outcome['failing_tiles']} of {rows * columns} tiles differ, smallest corrected p "
        f"{outcome['smallest_p_corrected']:.2g}"
    )


# --- the command -------------------------------------------------------------------------------------------------


def build_parser() -> argparse.ArgumentParser:
    """The command line."""
    parser = argparse.ArgumentParser(
        prog="python -m tools.reference", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("scene", type=Path, metavar="SCENE", help="scene.json, scene.xml, or glTF")
    parser.add_argument(
        "--override", action="extend", nargs="+", default=[], metavar="KEY=VALUE", help="change keys of the scene"
    )
    parser.add_argument(
        "--define", action="extend", nargs="+", default=[], metavar="NAME=VALUE", help="$NAME of a Mitsuba scene"
    )
    parser.add_argument("--error", type=float, metavar="E", help=f"relative standard error; default {DEFAULT_ERROR}")
    parser.add_argument("--spp", type=int, metavar="N", help="samples per pixel, in all")
    parser.add_argument("--seconds", type=float, metavar="S", help="of rendering, in all")
    parser.add_argument("--with", dest="renderer", choices=MAKERS, default="wavefront", help="default: wavefront")
    parser.add_argument("--seed", type=int, default=0, metavar="N", help="default 0")
    parser.add_argument("-o", "--output", type=Path, default=DEFAULT_FOLDER, metavar="FOLDER", help="of references")
    parser.add_argument("--every", type=float, default=60.0, metavar="S", help="between checkpoints; default 60")
    parser.add_argument("--threads", type=int, metavar="N", help="default: all cores")
    parser.add_argument("--device", default="cpu", help="cpu (default), cuda or cuda:N")
    return parser


def definitions(texts: Sequence[str]) -> dict[str, str]:
    """Values by name from ``NAME=VALUE``.

    Raises:
        WavefrontError: One that is not of this form.
    """
    pairs = [text.partition("=") for text in texts]
    for text, (name, equals, _) in zip(texts, pairs, strict=True):
        if not (name and equals):
            raise WavefrontError(f"--define {text!r}; allowed: NAME=VALUE")
    return {name: value for name, _, value in pairs}


def available_cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def run(arguments: argparse.Namespace) -> int:
    """Makes a reference; returns the exit status: 1 if another renderer's differs.

    Raises:
        WavefrontError: With the one line that the user needs.
    """
    console = Console(stderr=True, highlight=False, soft_wrap=True)
    limits = (arguments.error, arguments.spp, arguments.seconds)
    goal = Goal(*limits) if any(limit is not None for limit in limits) else Goal(error=DEFAULT_ERROR)
    if not arguments.every > 0.0:
        raise WavefrontError(f"--every {arguments.every:g}; allowed: more than 0")
    if arguments.threads is not None and arguments.threads < 1:
        raise WavefrontError(f"--threads {arguments.threads}; allowed: 1 or more")
    job = load_job(
        arguments.scene,
        arguments.override,
        definitions(arguments.define),
        arguments.threads or available_cores(),
        arguments.device,
        lambda message: console.print(f"warning: {message}"),
    )
    reference = make_reference(
        job, goal, arguments.output, arguments.renderer, arguments.seed, arguments.every, console
    )
    account = reference.account
    print(
        f"{reference.path}: {account.samples_per_pixel} spp in {account.seconds:.1f} s; relative standard error "
        f"{account.error:.2g}, median over pixels {account.median_error:.2g}"
    )
    outcomes = compare_stored(reference)
    for outcome in outcomes:
        print(in_words(outcome))
    return int(any(outcome["verdict"] == "differs" for outcome in outcomes))


def main(argv: list[str] | None = None) -> int:
    """Entry point; returns the exit status: 0, 1 where two renderers differ, or 2 after an error."""
    try:
        return run(build_parser().parse_args(argv))
    except (WavefrontError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("interrupted; the same command goes on from the last checkpoint", file=sys.stderr)
        return 130


if __name__ == "__main__":
    sys.exit(main())
