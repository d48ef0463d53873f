"""Our own scene format: JSON that says what `wavefront.scene.description` defines.

Reading: parse, apply overrides, convert to records, add what is included, make file paths absolute, validate.
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Callable, Sequence
from pathlib import Path

import msgspec

from wavefront.errors import SceneError
from wavefront.scene import description
from wavefront.scene.explain import explain, format_path, found
from wavefront.scene.lookup import NUMBER_FIELDS, shown, walk
from wavefront.scene.validate import validate

INCLUDABLE = ("textures", "bsdfs", "media", "emitters", "groups", "shapes", "instances")
_INCLUDE_KEYS = (*INCLUDABLE, "description", "include")
_OVERRIDE_STEP = re.compile(r"([A-Za-z_]\w*)((?:\[\d{1,9}\])*)")
_LINE_LENGTH = 120
_DEFAULT_CAMERA = description.Perspective.__struct_config__.tag  # of a camera that leaves its type out

# A string, which is stepped over, or a number that Python's parser would take or refuse but that is not in JSON.
_BAD_NUMBER = re.compile(r'"(?:\\.|[^"\\])*"|(NaN|-?Infinity|\d{1000,})')

# --- reading ---------------------------------------------------------------------------------------------------


def load(
    path: str | os.PathLike, overrides: Sequence[str] = (), warn: Callable[[str], object] | None = None
) -> description.Scene:
    """Reads a scene file, with what it includes.

    Args:
        path: The JSON file.
        overrides: Changes to the file before it is understood, such as ``integrator.max_depth=6``: a record path
            and a JSON value (anything that is not JSON is a string). Indices count the entries of this file alone,
            without included ones.
        warn: Called with each warning.

    Raises:
        SceneError: The file, or one that it includes or refers to, is missing or not valid.
    """
    raw = _read(path)
    scene = _convert(raw, path, overrides)
    _make_absolute(scene, Path(path).parent)
    origins = _add_included(scene, path)
    try:
        validate(scene, path, warn)
    except SceneError as error:
        raise _relocated(error, origins) from None
    return scene


def with_overrides(
    scene: description.Scene, overrides: Sequence[str], file: str | os.PathLike | None = None
) -> description.Scene:
    """A copy of `scene` with `overrides` applied, as `load` does; new file paths are relative to `file`. Not validated.

    Raises:
        SceneError: An override does not fit the scene.
    """
    scene = _convert(_to_builtins(scene), file, overrides)
    _make_absolute(scene, Path(file).parent if file else Path())
    return scene


def checked(scene: description.Scene) -> description.Scene:
    """A copy of a scene made from Python objects, its types and ranges checked as those of a file are. Not validated.

    Raises:
        SceneError: A field has a wrong type or is out of range.
    """
    return with_overrides(scene, ())


class _RepeatedKey(dict):
    """An object in which `key` was given twice: it is refused once its place in the file is known."""

    key: str


def _object(pairs):
    result = dict(pairs)
    if len(result) < len(pairs):
        seen = set()
        repeated = next(key for key, _ in pairs if key in seen or seen.add(key))
        result = _RepeatedKey(result)
        result.key = repeated
    return result


def _refuse_constant(name):
    raise ValueError(name)


_DECODER = json.JSONDecoder(object_pairs_hook=_object, parse_constant=_refuse_constant)


def _read(path):
    """The raw object in the file `path`."""
    try:
        return parse_object(Path(path).read_bytes(), path)
    except FileNotFoundError:
        raise SceneError("file not found", path) from None
    except IsADirectoryError:
        raise SceneError("is a directory; expected a scene file", path) from None
    except (OSError, ValueError) as error:
        raise SceneError(f"cannot be read: {getattr(error, 'strerror', None) or error}", path) from None


def parse_object(data: bytes, path: str | os.PathLike) -> dict:
    """The object that the JSON text `data` of the file `path` says: UTF-8, no key twice, no NaN.

    Raises:
        SceneError: With the line and column of what is wrong.
    """
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        raise SceneError(f"not UTF-8: byte 0x{data[error.start]:02x}", path, f"line {line}") from None
    raw = _parse(text, path)
    if not isinstance(raw, dict):
        raise SceneError(f"expected an object; found {found(raw)}", path)
    return raw


def _parse(text, path):
    try:
        raw = _DECODER.decode(text)
    except json.JSONDecodeError as error:
        where = f"line {error.lineno}, column {error.colno}"
        raise SceneError(f"not JSON: {error.msg[:1].lower()}{error.msg[1:]}", path, where) from None
    except RecursionError:
        raise SceneError("nested too deeply", path) from None
    except ValueError:
        raise _bad_number(text, path) from None
    for steps, item in containers(raw):
        if isinstance(item, _RepeatedKey):
            raise SceneError(f"the key {shown(item.key)} is given twice", path, printable_path(steps))
    return raw


def _bad_number(text, path):
    """The error for what the parser refuses without saying where: a constant such as NaN, or an endless integer."""
    for match in _BAD_NUMBER.finditer(text):
        if match[1]:
            line, column = text.count("\n", 0, match.start()) + 1, match.start() - text.rfind("\n", 0, match.start())
            what = f"an integer of {len(match[1])} digits" if match[1].isdigit() else match[1]
            return SceneError(f"not JSON: {what} is not a number here", path, f"line {line}, column {column}")
    return SceneError("not JSON: a number cannot be read", path)


def containers(raw):
    """All objects in `raw` with the steps to them; lists of numbers are not looked into."""
    stack = [([], raw)] if isinstance(raw, (dict, list)) else []
    while stack:
        steps, item = stack.pop()
        if isinstance(item, dict):
            yield steps, item
            children = [([*steps, key], child) for key, child in item.items() if key not in NUMBER_FIELDS]
        else:
            children = [([*steps, i], child) for i, child in enumerate(item)]
        stack.extend(child for child in reversed(children) if isinstance(child[1], (dict, list)))


def printable_path(steps):
    """A path such as ``bsdfs[2].alpha`` from its steps, quoted where a key is not a word."""
    return format_path([step if isinstance(step, int) or step.isidentifier() else shown(step) for step in steps])


def _convert(raw, path, overrides=()):
    """Records from a raw object that `overrides` change first."""
    applied = [_apply_override(raw, override, path) for override in overrides]
    if isinstance(raw.get("camera"), dict):
        raw["camera"].setdefault("type", _DEFAULT_CAMERA)
    try:
        return msgspec.convert(raw, description.Scene)
    except RecursionError:
        raise SceneError("nested too deeply", path) from None
    except (msgspec.ValidationError, ValueError, OverflowError) as error:
        steps, message, key = explain(raw, error)
    for override, target in zip(reversed(overrides), reversed(applied), strict=True):
        if steps[: len(target)] == target or (key is not None and [*steps, key][: len(target)] == target):
            message += f" (set by {shown(override)})"
            break
    raise SceneError(message, path, printable_path(steps))


def _make_absolute(scene, base):
    for _, record in walk(scene):
        if isinstance(record, (description.Bitmap, description.Envmap, description.Mesh)) and record.file:
            record.file = os.path.abspath(os.path.join(base, record.file))


# --- overrides -------------------------------------------------------------------------------------------------


def _apply_override(raw, override, path):
    """Changes `raw` as `override` says and returns the steps to what it changed."""
    name, equals, text = override.partition("=")
    steps = _parse_override_path(name)
    if not equals or steps is None:
        message = f"bad override {shown(override)}; expected a path and a value such as integrator.max_depth=6"
        raise SceneError(message, path)
    try:
        value = _parse(text, path)
    except SceneError:
        value = text
    holder, default = raw, _defaults()
    for i, step in enumerate(steps):
        place = format_path(steps[:i]) or "the scene"
        if isinstance(step, int):
            if not isinstance(holder, list) or step >= len(holder):
                has = f"has {len(holder)} entries" if isinstance(holder, list) else "is not a list"
                raise SceneError(f"{place} {has} (set by {shown(override)})", path)
        elif not isinstance(holder, dict):
            raise SceneError(f"{place} has no keys; found {found(holder)} (set by {shown(override)})", path)
        if i == len(steps) - 1:
            if step == "type" and holder.get("type") != value:  # another type starts from its own defaults
                kept = holder.get("name")
                holder.clear()
                holder.update({} if kept is None else {"name": kept})
            holder[step] = value
            break
        default = default.get(step, {}) if isinstance(default, dict) and isinstance(step, str) else {}
        if isinstance(holder, dict) and step not in holder:
            holder[step] = dict(default)
        holder = holder[step]
    return steps


def _parse_override_path(name):
    steps = []
    for part in name.strip().split("."):
        match = _OVERRIDE_STEP.fullmatch(part)
        if not match:
            return None
        steps.append(match[1])
        steps.extend(int(index) for index in re.findall(r"\d+", match[2]))
    return steps


def _defaults():
    """The raw objects that stand for records which a file leaves out."""
    return msgspec.to_builtins(description.Scene())


# --- include ---------------------------------------------------------------------------------------------------


def _add_included(scene, path):
    """Puts what `scene` includes before its own records; a file that is reached twice is added once.

    Returns:
        For each list, the (file, index) that each entry comes from.
    """
    lists = {name: [] for name in INCLUDABLE}
    origins = {name: [] for name in INCLUDABLE}
    _collect(scene, path, [os.path.realpath(path)], set(), lists, origins)
    for name in INCLUDABLE:
        setattr(scene, name, lists[name])
    scene.include = []
    return origins


def _collect(scene, path, open_files, done, lists, origins):
    for i, name in enumerate(scene.include):
        where = f"include[{i}]"
        file = os.path.join(os.path.dirname(path), name)
        real = os.path.realpath(file) if "\0" not in file else file
        if real in open_files:
            raise SceneError(f"{shown(name)} includes this file in turn", path, where)
        if not os.path.isfile(real):
            raise SceneError(f"file not found: {shown(name)}", path, where)
        if real in done:
            continue
        raw = _read(file)
        for key in raw:
            if key not in _INCLUDE_KEYS:
                raise SceneError(
                    f"key {shown(key)} cannot be included; an included file has only: {', '.join(_INCLUDE_KEYS)}", file
                )
        part = _convert(raw, file)
        _make_absolute(part, os.path.dirname(file))
        _collect(part, file, [*open_files, real], done, lists, origins)
        done.add(real)
    for name in INCLUDABLE:
        own = getattr(scene, name)
        lists[name].extend(own)
        origins[name].extend((path, index) for index in range(len(own)))


def _relocated(error, origins):
    """`error` with the file and the index that its record has there."""
    match = re.match(r"(\w+)\[(\d+)\](.*)", error.path)
    if not match or match[1] not in origins:
        return error
    file, index = origins[match[1]][int(match[2])]
    return SceneError(error.message, file, f"{match[1]}[{index}]{match[3]}")


# --- writing ---------------------------------------------------------------------------------------------------


def dump(scene: description.Scene, path: str | os.PathLike) -> None:
    """Writes `scene` to `path`; ``load`` gives an equal scene back. The file is replaced whole or not at all.

    Raises:
        SceneError: A number is not finite.
        WavefrontError: The file cannot be written.
    """
    from wavefront.scene.images import replacing  # only here: reading a scene needs no image libraries

    text = dumps(scene, Path(path).parent)
    with replacing(path) as temporary:
        temporary.write_bytes(text.encode())


def dumps(scene: description.Scene, base_dir: str | os.PathLike) -> str:
    """The JSON text of `scene`, file paths relative to `base_dir`, defaults left out.

    Raises:
        SceneError: A number is not finite.
    """
    raw = _to_builtins(scene)
    for steps, item in containers(raw):
        if isinstance(item.get("file"), str):
            item["file"] = _relative(item["file"], base_dir)
        if not steps and "include" in item:
            item["include"] = [_relative(file, base_dir) for file in item["include"]]
    defaults = _defaults()
    if "film" in raw and raw["film"].get("filter") == defaults["film"]["filter"]:
        del raw["film"]["filter"]
    for key in ("camera", "film", "integrator"):
        if not raw[key] or raw[key] == defaults[key]:
            del raw[key]
    order = ("description", "include", "camera", "film", "integrator", *INCLUDABLE)
    try:
        return _write({key: raw[key] for key in order if key in raw}, "", 0) + "\n"
    except ValueError:
        raise SceneError("a number of the scene is not finite") from None


def _to_builtins(scene):
    # NumPy arrays and scalars stand for lists and numbers in scenes made from Python objects.
    return msgspec.to_builtins(scene, enc_hook=lambda value: value.tolist())


def _relative(file, base_dir):
    try:
        return Path(os.path.relpath(file, base_dir)).as_posix()
    except ValueError:  # on another drive
        return Path(file).as_posix()


def _write(value, indent, used):
    """JSON text of `value`, on one line if it fits there after `used` characters, number rows one per line."""
    if not isinstance(value, (dict, list)) or not value:
        return json.dumps(value, allow_nan=False)
    inner = indent + "  "
    if isinstance(value, list) and _is_table(value):
        if len(value) > 3:
            rows = json.dumps(value, allow_nan=False)
            return rows.replace("[[", f"[\n{inner}[").replace("], [", f"],\n{inner}[").replace("]]", f"]\n{indent}]")
        return json.dumps(value, allow_nan=False)
    flat = json.dumps(value, allow_nan=False) if _is_small(value) else None
    if flat is not None and indent and len(indent) + used + len(flat) < _LINE_LENGTH:
        return flat
    if isinstance(value, list):
        items = [inner + _write(item, inner, 1) for item in value]
        return "[\n" + ",\n".join(items) + f"\n{indent}]"
    items = [f"{inner}{json.dumps(key)}: " + _write(item, inner, len(key) + 5) for key, item in value.items()]
    return "{\n" + ",\n".join(items) + f"\n{indent}}}"


def _is_table(value):
    return len(value) > 0 and all(
        isinstance(row, (list, tuple)) and all(isinstance(item, (int, float)) for item in row) for row in value
    )


def _is_small(value):
    """Whether a container is worth trying on one line: little in it, no table of many rows."""
    items = list(value.values()) if isinstance(value, dict) else value
    if len(items) > 12:
        return False
    return all(not isinstance(item, (dict, list)) or (not _long_table(item) and _is_small(item)) for item in items)


def _long_table(item):
    return isinstance(item, list) and len(item) > 3 and _is_table(item)


# --- schema ----------------------------------------------------------------------------------------------------


def schema() -> dict:
    """The JSON Schema (draft 2020-12) of a scene file, made from the records."""
    generated = msgspec.json.schema(description.Scene)
    told_apart = set()
    _find_unions(generated, told_apart)
    told_apart.discard("#/$defs/Perspective")  # of cameras, the one that needs no type
    for definition in generated["$defs"].values():
        # A record that stands where no other can may leave its type out.
        if f"#/$defs/{definition['title']}" not in told_apart:
            definition["required"] = [key for key in definition["required"] if key != "type"]
        if not definition["required"]:
            del definition["required"]
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": "Wavefront scene",
        "description": "Right-handed, Y up, metres, degrees, linear Rec. 709 colour; paths are relative to the file.",
        **generated,
    }


def _find_unions(node, told_apart):
    if isinstance(node, dict):
        told_apart.update(node.get("discriminator", {}).get("mapping", {}).values())
        for child in node.values():
            _find_unions(child, told_apart)
    elif isinstance(node, list):
        for child in node:
            _find_unions(child, told_apart)
