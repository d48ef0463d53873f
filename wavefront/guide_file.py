"""A file of what a guide has learned, to be used by another render: of another view, say, or with more samples.

It is written and read as a checkpoint is (`wavefront.checkpoint`): an npz without pickle, of ``about.json`` and the
arrays of `Guide.arrays` under ``guide/``, under a temporary name first.
"""

from __future__ import annotations

import os

import wavefront
from wavefront.checkpoint import read_checkpoint, write_checkpoint
from wavefront.guide import Guide

KIND = "guide file"
# Settings of how a guide begins, how long it learns and how much it is trusted: what it has learned fits others too.
OF_USE = ("seed", "train_share", "bsdf_share")


def guide_identity(guide: Guide) -> dict:
    """What must be equal for a guide to take over what another has learned."""
    settings = {key: value for key, value in guide.identity().items() if key not in OF_USE}
    return {"method": guide.name, "settings": settings, "wavefront": wavefront.__version__}


def save_guide(guide: Guide, path: str | os.PathLike) -> None:
    """Writes what a guide of a renderer has learned; `path` is replaced whole or not at all.

    Raises:
        CheckpointError: The file cannot be written; what was there is still there.
    """
    about = {"identity": guide_identity(guide), "statistics": guide.statistics()}
    write_checkpoint(path, about, {"guide": guide.arrays()}, KIND)


def load_guide(guide: Guide, path: str | os.PathLike) -> None:
    """Fills a guide, which a renderer has, with what another one had learned. It is used from the next pass on.

    The image is right whatever the scene was that it learned from.

    Raises:
        CheckpointError: Missing, damaged, or of another method, other settings or another version, with what differs;
            nothing has changed then.
    """
    read_checkpoint(path, guide_identity(guide), {"guide": guide.arrays()}, kind=KIND, of="guide")
    guide.restored()
