"""Which joints of common skeletons and marker sets are which part of a person."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence

from clamber.demo.demonstration import PARTS, REQUIRED
from clamber.errors import InputError

# Canonical point: names in order of preference, lower case without separators, after
# `left` or `l` (either side alike). The ankle is the reference point of a foot.
_SIDED = {
    "Hand": ("wrist", "hand", "wristjoint"),
    "Hand.knuckle": ("handmiddle1", "middle1", "middle01", "knuckle", "hand.knuckle"),
    "Hand.tip": ("handmiddle3", "middle3", "middle03", "tip", "hand.tip"),
    "Hand.thumb": ("handthumb3", "thumb3", "thumb03", "thumb", "hand.thumb"),
    "Elbow": ("elbow", "forearm", "elbowjoint", "lowerarm"),
    "Shoulder": ("arm", "upperarm", "shoulder", "shoulderjoint"),
    "Hip": ("upleg", "hip", "thigh", "hipjoint"),
    "Knee": ("knee", "leg", "kneejoint", "calf", "shin"),
    "Foot": ("ankle", "foot", "anklejoint"),
    "Foot.toe": ("toebase", "toe", "foot.toe", "ball", "foot"),
}
_MIDDLE = {
    "Pelvis": ("pelvis", "hips", "hip", "root"),
    "Head": ("head",),
    "Neck": ("neck",),
}


def canonical_columns(
    names: Sequence[str],
    parts: Mapping[str, str | Sequence[str]] | None,
    source: object,
) -> dict[str, int]:
    """Column of each canonical point.

    Args:
        names: Of the columns.
        parts: Canonical point to the recording's name, or to several: the first is
            the part's reference point. They go before what is recognised.
        source: The file, for messages.

    Raises:
        InputError: A needed point is neither given nor recognised.
    """
    index = {n: i for i, n in enumerate(names)}
    plain: dict[str, int] = {}
    for n, i in index.items():
        plain.setdefault(re.sub(r"[\s_\-:]", "", n).lower(), i)
    columns: dict[str, int] = {}
    for point, given in (parts or {}).items():
        several = [given] if isinstance(given, str) else list(given)
        for k, name in enumerate(several):
            if name not in index:
                raise InputError(
                    f"one of the names of the recording: {_listed(names)}",
                    source=source,
                    field=f"parts.{point}",
                    value=name,
                )
            columns[point if k == 0 else f"{point}.{k}"] = index[name]
    given_parts = {p.split(".")[0] for p in columns}
    for side, prefixes in (("L", ("left", "l")), ("R", ("right", "r"))):
        for point, words in _SIDED.items():
            if (side + point).split(".")[0] in given_parts:
                continue
            taken = set(columns.values())
            candidates = (plain.get(p + w, -1) for w in words for p in prefixes)
            found = next((c for c in candidates if c >= 0 and c not in taken), None)
            if found is not None:
                columns[side + point] = found
    for point, words in _MIDDLE.items():
        found = next((plain[w] for w in words if w in plain), None)
        if point not in columns and found is not None:
            columns[point] = found
    for side, prefixes in (("L", ("left", "l")), ("R", ("right", "r"))):
        found = next(
            (plain[p + w] for w in _SIDED["Hand"] for p in prefixes if p + w in plain),
            None,
        )
        if found not in (None, columns.get(side + "Hand")):
            columns.setdefault(side + "Wrist", found)  # the hand was named otherwise
    missing = [p for p in REQUIRED if p not in columns and p != "Pelvis"]
    if missing:
        raise InputError(
            f"a joint for each of {', '.join(missing)}: name them under `parts`; "
            f"the recording has {_listed(names)}",
            source=source,
            field="names",
        )
    return columns


def known_point(point: str) -> bool:
    """Whether `parts` may name this point."""
    base = point.split(".")[0]
    return base in {*PARTS, *REQUIRED, *_MIDDLE, "LWrist", "RWrist"}


def _listed(names: Sequence[str]) -> str:
    shown = ", ".join(names[:12])
    return shown if len(names) <= 12 else f"{shown} ... ({len(names)})"
