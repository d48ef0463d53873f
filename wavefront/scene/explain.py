"""What is wrong with a raw scene object, in the words of the scene format.

msgspec tells where a value does not fit the records; the type found there tells what would fit.
"""

from __future__ import annotations

import contextlib
import difflib
import functools
import re
import sys

from msgspec import inspect

from wavefront.scene import description
from wavefront.scene.lookup import shown

Step = str | int
_STEP = re.compile(r"\.([A-Za-z_]\w*)|\[(\d+)\]")


def explain(raw: object, error: Exception, root: type = description.Scene) -> tuple[list[Step], str, str | None]:
    """Where and why `raw` is not a scene (or another `root`), from the exception that ``msgspec.convert`` raised.

    Returns:
        The steps to the value, the message, and the unknown key if that is the trouble.
    """
    steps = _error_steps(str(error))
    tag = None
    if steps and steps[-1] == "type":  # the record that cannot be told apart, not its tag
        tag = steps.pop()
    try:
        value, types = _descend(raw, steps, root)
    except (LookupError, TypeError):
        return [], _first_line(error), None
    if isinstance(value, dict) and any(isinstance(t, inspect.StructType) for t in types):
        message, key, at_type = _explain_object(value, types)
        if message:
            return [*steps, "type"] if at_type else steps, message, key
    if tag is not None:
        steps.append(tag)
        with contextlib.suppress(LookupError, TypeError):  # of a record that has a type as its own field
            value, types = _descend(raw, steps, root)
    if isinstance(value, int) and abs(value) > sys.float_info.max:
        return steps, f"the number {found(value)} is too large", None
    if not isinstance(value, (dict, list)) or not _allows(types, value):
        return steps, f"expected {allowed(types)}; found {found(value)}", None
    return steps, _first_line(error), None


def format_path(steps: list[Step]) -> str:
    """A record path such as ``bsdfs[2].alpha``."""
    text = "".join(f"[{step}]" if isinstance(step, int) else f".{step}" for step in steps)
    return text.removeprefix(".")


def found(value: object) -> str:
    """A value of a file as a message quotes it."""
    if value is None:
        return "null"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        return f"the string {shown(value)}"
    if isinstance(value, list):
        if len(value) <= 6 and all(isinstance(item, (int, float)) for item in value):
            return _shorten(str(value))
        return f"a list of {len(value)} item{'s' * (len(value) != 1)}"
    if isinstance(value, dict):
        return "an object"
    try:
        return _shorten(str(value))
    except ValueError:  # an integer with more digits than Python converts
        return "a huge integer"


def allowed(types: tuple[inspect.Type, ...]) -> str:
    """What a value of one of `types` may be, in words."""
    tags = [t.tag for t in types if isinstance(t, inspect.StructType) and t.tag is not None]
    words = []
    for kind in types:
        if isinstance(kind, inspect.StructType):
            if kind.tag is None:
                words.append("an object")
        elif isinstance(kind, inspect.StrType):
            words.append("a name" if tags else _singular(kind))
        else:
            words.append(_singular(kind))
    if tags:
        words.append(f"an object of type {_either([repr(tag) for tag in tags])}")
    return _either(words)


@functools.cache
def _type_info(root: type) -> inspect.Type:
    return inspect.type_info(root)


def _error_steps(message: str) -> list[Step]:
    start = message.rfind(" - at `$")
    return [int(index) if index else name for name, index in _STEP.findall(message[start + 8 :])] if start >= 0 else []


def _variants(kind: inspect.Type) -> tuple[inspect.Type, ...]:
    """The members of a union, metadata stripped."""
    if isinstance(kind, inspect.Metadata):
        return _variants(kind.type)
    if isinstance(kind, inspect.UnionType):
        return tuple(variant for member in kind.types for variant in _variants(member))
    return (kind,)


def _descend(raw, steps, root):
    """The value at `steps` and the types it may have."""
    value, types = raw, _variants(_type_info(root))
    for step in steps:
        parent, value = value, value[step]
        if isinstance(step, int):
            inner = [
                t.item_type if isinstance(t, inspect.ListType) else t.item_types[min(step, len(t.item_types) - 1)]
                for t in types
                if isinstance(t, (inspect.ListType, inspect.TupleType))
            ]
        else:
            records = [t for t in types if isinstance(t, inspect.StructType)]
            told = [t for t in records if t.tag == parent.get("type")] or records
            inner = [field.type for t in told for field in t.fields if field.encode_name == step]
        types = tuple(variant for kind in inner for variant in _variants(kind))
        if not types:
            raise LookupError(step)
    return value, types


def _explain_object(value, types):
    """Message, unknown key, and whether the record's type is the trouble."""
    records = [t for t in types if isinstance(t, inspect.StructType)]
    tags = [t.tag for t in records if t.tag is not None]
    if tags:
        listed = f"allowed: {', '.join(map(repr, tags))}"
        if "type" not in value:
            if len(records) > 1:
                return f"missing key 'type'; {listed}", None, False
        elif not isinstance(value["type"], str):
            return f"expected a string; found {found(value['type'])}; {listed}", None, True
        elif value["type"] not in tags:
            return f"unknown type {shown(value['type'])}{_nearest(value['type'], tags)} {listed}", None, True
        else:
            records = [t for t in records if t.tag == value["type"]]
    record = records[0]
    keys = (["type"] if record.tag is not None else []) + [field.encode_name for field in record.fields]
    for key in value:
        if key not in keys and record.forbid_unknown_fields:
            return f"unknown key {shown(key)}{_nearest(key, keys)} valid keys: {', '.join(keys)}", key, False
    for field in record.fields:
        if field.required and field.encode_name not in value:
            return f"missing key {field.encode_name!r}", None, False
    return "", None, False


def _nearest(word, words):
    close = difflib.get_close_matches(word, words, n=2)
    return f"; did you mean {_either([repr(other) for other in close])}?" if close else ";"


def _allows(types, value):
    """Whether a container is of a right kind, so that something inside it must be the trouble."""
    if isinstance(value, dict):
        return any(isinstance(t, (inspect.StructType, inspect.DictType)) for t in types)
    for kind in types:
        if isinstance(kind, inspect.TupleType) and len(value) == len(kind.item_types):
            return True
        if isinstance(kind, inspect.ListType):
            least, most = kind.min_length or 0, kind.max_length
            if least <= len(value) and (most is None or len(value) <= most):
                return True
    return False


def _singular(kind):
    if isinstance(kind, inspect.NoneType):
        return "null"
    if isinstance(kind, inspect.BoolType):
        return "true or false"
    if isinstance(kind, inspect.LiteralType):
        return _either([repr(value) for value in kind.values])
    if isinstance(kind, inspect.StrType):
        return "a string that is not empty" if kind.min_length else "a string"
    if isinstance(kind, inspect.IntType):
        return "an integer" + _range(kind)
    if isinstance(kind, inspect.FloatType):
        return "a number" + _range(kind)
    if isinstance(kind, inspect.DictType):
        return "an object"
    return "a list of " + _plural(kind)


def _plural(kind):
    if isinstance(kind, inspect.TupleType):
        inner = kind.item_types[0]
        count, items = len(kind.item_types), (inner,)
    else:
        count, items = kind.max_length, _variants(kind.item_type)
    words = []
    for item in items:
        if isinstance(item, inspect.FloatType):
            words.append("numbers" + _range(item))
        elif isinstance(item, inspect.IntType):
            words.append("integers" + _range(item))
        elif isinstance(item, (inspect.TupleType, inspect.ListType)):
            words.append("lists of " + _plural(item))
        elif isinstance(item, inspect.StrType):
            words.append("strings")
        elif isinstance(item, inspect.LiteralType):
            words.append(_either([repr(value) for value in item.values]))
        elif "objects" not in words:
            words.append("objects")
    return f"{count} {_either(words)}" if count else _either(words)


def _range(kind):
    bounds = [
        f"{sign} {bound:g}" if isinstance(bound, float) else f"{sign} {bound}"
        for sign, bound in ((">=", kind.ge), (">", kind.gt), ("<=", kind.le), ("<", kind.lt))
        if bound is not None
    ]
    return " " + " and ".join(bounds) if bounds else ""


def _either(words):
    words = list(dict.fromkeys(words))
    return words[0] if len(words) == 1 else ", ".join(words[:-1]) + " or " + words[-1]


def _shorten(text):
    return text if len(text) <= 60 else text[:57] + "..."


def _first_line(error):
    text = str(error) or type(error).__name__
    return shown(text)[1:-1] if not text.isprintable() else text
