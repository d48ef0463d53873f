"""What a render is of: its scene without the number of samples, so that renders can be continued and combined."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

import msgspec

from wavefront.scene import description
from wavefront.scene.lookup import NUMBER_FIELDS, walk

_LISTED = 4  # differences that a message lists at most
# Keys that say how many samples there are and how they are written, not what they are samples of; and the guide, which
# is part of a renderer's identity with all its settings.
_OMITTED = (("integrator", "spp"), ("integrator", "guide"), ("film", "precision"))


def scene_records(scene: description.Scene) -> dict:
    """The records of a scene as plain values that can be compared with those of another.

    Files are in it by the SHA-256 of their contents, wherever they lie, and so are long lists of numbers. The number of
    samples, the guide and the precision of the output are left out.
    """
    files: dict[str, str] = {}
    for _, record in walk(scene):
        file = getattr(record, "file", None)
        if file and file not in files:
            files[file] = hashlib.sha256(Path(file).read_bytes()).hexdigest()

    def plain(value, key=""):
        if isinstance(value, dict):
            return {k: plain(v, k) for k, v in value.items()}
        if isinstance(value, list):
            if key in NUMBER_FIELDS:
                return hashlib.sha256(json.dumps(value).encode()).hexdigest()
            return [plain(v) for v in value]
        return files.get(value, value) if key == "file" else value

    records = plain(msgspec.to_builtins(scene))
    for part, key in _OMITTED:
        records[part].pop(key, None)
    return records


def scene_hash(records: dict) -> str:
    """SHA-256 of what `scene_records` gives."""
    return hashlib.sha256(json.dumps(records, sort_keys=True).encode()).hexdigest()


def differences(here: object, there: object, path: str = "") -> list[tuple[str, object, object]]:
    """The places in which two plain values differ: path, value here, value there (None where there is none)."""
    if isinstance(here, dict) and isinstance(there, dict):
        found = []
        for key in dict.fromkeys([*here, *there]):
            found += differences(here.get(key), there.get(key), f"{path}.{key}" if path else str(key))
        return found
    if isinstance(here, list) and isinstance(there, list) and len(here) == len(there):
        pairs = zip(here, there, strict=True)
        return [entry for i, (a, b) in enumerate(pairs) for entry in differences(a, b, f"{path}[{i}]")]
    return [] if here == there else [(path, here, there)]


def explain_differences(here: object, there: object, where: str) -> str:
    """One line that lists differences, as in ``integrator.max_depth is 6, but 5 in WHERE``; empty if there are none."""

    def shown(value):
        text = json.dumps(value)
        return text if len(text) <= 40 else text[:37] + "..."

    found = differences(here, there)
    parts = [f"{path} is {shown(a)}, but {shown(b)} in {where}" for path, a, b in found[:_LISTED]]
    if len(found) > _LISTED:
        parts.append(f"and {len(found) - _LISTED} more differences")
    return "; ".join(parts)
