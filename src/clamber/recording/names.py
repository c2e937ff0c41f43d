"""Names of joints and markers: one grammar for the conventions of all tools.

A name is a side and a word, in any order and with any separators: `LeftLeg`, `thigh_l`,
`thigh.L`, `KneeLeft`, `Bip01 L Thigh`, `jLeftKnee`, `l_shank_4X4`, `R.Knee.Lat`. What
all names begin with (`mixamorig:`) says nothing. The words are the tables below.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence

# Joint centres. Canonical point: words in order of preference, lower case without
# separators. The ankle is the reference point of a foot.
JOINTS = {
    "Hand": (
        "wrist", "hand", "wristjoint", "wjc", "rao", "radiushand", "radiocarpal",
    ),
    "Hand.knuckle": (
        "handmiddle1", "middle1", "middle01", "knuckle", "handknuckle", "fingerbase",
        "index", "hno", "handjc", "hand",
    ),
    "Hand.tip": (
        "handmiddle3", "middle3", "middle03", "tip", "handtip", "handindex1end",
        "handend", "fingers",
    ),
    "Hand.thumb": ("handthumb3", "thumb3", "thumb03", "thumb", "handthumb"),
    "Elbow": (
        "elbow", "forearm", "farm", "elbowjoint", "lowerarm", "ulna", "radius", "larm",
        "loarm", "forearmbend", "ejc", "huo", "radioulnar",
    ),
    "Shoulder": (
        "arm", "uarm", "upperarm", "humerus", "shoulder", "shoulderjoint", "uparm",
        "shldr", "shldrbend", "sjc", "hup", "acromial", "glenohumeral",
    ),
    "Hip": (
        "upleg", "femur", "hip", "thigh", "hipjoint", "upperleg", "thighbend", "hjc",
        "fep",
    ),
    "Knee": (
        "knee", "leg", "tibia", "kneejoint", "calf", "shin", "shank", "lowerleg",
        "loleg", "kjc", "feo",
    ),
    "Foot": ("ankle", "foot", "anklejoint", "talus", "ajc", "tio", "calcn"),
    "Foot.toe": (
        "toebase", "toe", "toes", "foottoe", "ball", "ballfoot", "footindex", "bigtoe",
        "mtp", "too", "foot", "footend",
    ),
}  # fmt: skip
# Of no side.
MIDDLE = {
    "Pelvis": (
        "pelvis", "hips", "hip", "spinebase", "hipscenter", "hipcenter", "midhip",
        "pelo", "root",
    ),
    "Head": ("head", "headtop", "thead"),
    "Neck": ("neck", "neck1", "lowerneck", "neck01"),
}  # fmt: skip
# Markers on the skin. Place: alternatives; the first whose words all exist counts, and
# is their mean. `*` before a word: one marker of no side serves both.
PLACES: dict[str, tuple[tuple[str, ...], ...]] = {
    "Asis": (
        ("asi",), ("asis",), ("ias",), ("waistfront",), ("fwt",), ("iliacfront",),
    ),
    "Psis": (
        ("psi",), ("psis",), ("ips",), ("waistback",), ("bwt",), ("*sacr",),
        ("*sacrum",), ("*vsacral",), ("*sacral",), ("*vsacr",), ("*waistback",),
        ("*mbwt",),
    ),
    "KneeOut": (
        ("kne",), ("kneeout",), ("kneelat",), ("latknee",), ("kneelateral",), ("fle",),
        ("lfc",), ("lek",), ("lepi",), ("knel",), ("lkne",), ("lknee",), ("knee",),
    ),
    "KneeIn": (
        ("knm",), ("knem",), ("mkne",), ("kneein",), ("kneemed",), ("medknee",),
        ("kneemedial",), ("fme",), ("mfc",), ("mek",), ("mepi",), ("kni",), ("mknee",),
        ("kneem",),
    ),
    "AnkleOut": (
        ("ank",), ("ankleout",), ("anklelat",), ("latankle",), ("anklelateral",),
        ("fal",), ("lma",), ("lmal",), ("lm",), ("ankl",), ("lank",), ("lankle",),
        ("ankle",),
    ),
    "AnkleIn": (
        ("anm",), ("ankm",), ("mank",), ("mmed",), ("med",), ("anklein",),
        ("anklemed",), ("medankle",), ("anklemedial",), ("tam",), ("mma",), ("mmal",),
        ("mm",), ("mankle",),
    ),
    "Toe": (
        ("toe",), ("toein", "toeout"), ("forefootin", "forefootout"), ("toeout",),
        ("forefootout",), ("mt2",), ("forefoot2",), ("fm2",), ("2nd",), ("smh",),
        ("mt1", "mt5"), ("toemed", "toelat"), ("fm1", "fm5"), ("1st", "5th"),
        ("mth1", "mth5"), ("mt5",), ("toetip",), ("hlx",), ("5meta",),
    ),
    "Acromion": (
        ("sho",), ("shouldertop",), ("acr",), ("acromion",), ("acromium",), ("sae",),
        ("frontshoulder", "backshoulder"), ("shoulder",),
    ),
    "ElbowOut": (
        ("elb",), ("elbowout",), ("elbowlat",), ("latelbow",), ("elbowlateral",),
        ("hle",), ("lee",), ("lel",), ("elbl",), ("lelb",), ("lelbow",), ("elbow",),
    ),
    "ElbowIn": (
        ("elbm",), ("melb",), ("elbowin",), ("elbowmed",), ("medelbow",),
        ("elbowmedial",), ("hme",), ("mee",), ("mel",), ("iel",), ("melbow",),
    ),
    "Wrist": (
        ("wra", "wrb"), ("wristin", "wristout"), ("wristlat", "wristmed"),
        ("latwrist", "medwrist"), ("lwrist", "mwrist"), ("rsp", "usp"), ("lw", "mw"),
        ("wristradius", "wristulna"),
        ("faradius", "faulna"), ("iwr", "owr"), ("wri",), ("wrist",),
        ("wristtop",), ("wra",),
    ),
    "HandBack": (
        ("fin",), ("handin", "handout"), ("handout",), ("hm2", "hm5"), ("hm2",),
        ("hand2",), ("mwt",), ("handtop",), ("hand",),
    ),
    "Head": (("*lfhd", "*rfhd", "*lbhd", "*rbhd"), ("*headtop",), ("*thead",)),
    "Neck": (("*c7",), ("*backtop",), ("*spinetop",), ("*cv7",), ("*tv1",)),
}  # fmt: skip
# What a set is called, by names (lower case, no separators) that no other has.
_JOINT_SETS = (
    ("Motive skeleton", ("luarm", "lfarm", "lshin")),
    ("SMPL joints", ("leftcollar", "spine3", "leftwrist")),
    ("CMU skeleton", ("lhipjoint", "leftupleg", "lowerback")),
    ("CMU skeleton", ("lfemur", "ltibia", "lhumerus")),
    ("LAFAN skeleton", ("leftupleg", "lefttoe", "spine2")),
    ("Mixamo-like skeleton", ("leftupleg", "leftforearm", "hips")),
    ("SOMA skeleton", ("leftleg", "leftshin", "leftforearm")),
    ("Rokoko skeleton", ("leftthigh", "leftshin", "leftforearm")),
    ("Xsens joints", ("jlefthip", "jleftknee", "jleftankle")),
    ("Xsens segments", ("leftupperleg", "leftlowerleg", "leftforearm")),
    ("Unreal skeleton", ("thighl", "calfl", "lowerarml")),
    ("Biped", ("lthigh", "lcalf", "lupperarm")),
    ("Theia segments", ("lthigh4x4", "lshank4x4", "luarm4x4")),
    ("OpenSim bodies", ("femurl", "tibial", "humerusl")),
    ("Kinect joints", ("hipleft", "kneeleft", "ankleleft")),
    ("MediaPipe landmarks", ("leftknee", "leftheel", "leftfootindex")),
    ("Plug-in Gait joint centres", ("lfep", "lfeo", "ltio")),
    ("clamber's own points", ("lhand", "lelbow", "lfoottoe")),
)
_MARKER_SETS = (
    ("CMU markers", ("lfwt", "lbwt", "lkne")),
    ("Plug-in Gait markers", ("lasi", "lkne", "lank")),
    ("Qualisys markers", ("waistlfront", "lforefootout")),
    ("Qualisys markers", ("waistlfront", "spinetop")),
    ("Motive Baseline markers", ("waistlfront", "lkneeout")),
    ("OpenCap markers", ("lkneestudy", "lmkneestudy")),
    ("OpenSim markers", ("lasis", "lkneelat")),
)

_SIDES = {"l": "L", "r": "R", "left": "L", "right": "R", "lft": "L", "rgt": "R"}
_SEPARATORS = re.compile(r"[\s_.\-:/|#']+")
_CAMEL = re.compile(r"[A-Z]+(?=[A-Z][a-z])|[A-Z]?[a-z]+|[A-Z]+|\d+")
# Ends of names that say nothing of the place.
_IDLE = {"4x4", "study", "joint", "jnt", "jc", "bone", "pos", "position", "marker"}
_FIRST = re.compile(r"(?:0|00?1)$")  # the first of several, such as `Toe0`
_MANY = 8  # names that begin alike before it is a person's name
_MOST = 0.8  # of all names begin with what says nothing


def set_name(kind: str, plain: Sequence[str]) -> str:
    """Name of a marker set or skeleton.

    Args:
        kind: `joints` or `markers`.
        plain: The names, lower case without separators.
    """
    known = _JOINT_SETS if kind == "joints" else _MARKER_SETS
    there = set(plain)
    called = (name for name, words in known if there.issuperset(words))
    return next(called, f"{kind} by their names")


def plain_name(name: str) -> str:
    """Lower case, without separators."""
    return _SEPARATORS.sub("", name).lower()


def prefixes_of(names: Sequence[str]) -> list[str]:
    """Prefixes that may be a namespace or a person; none first, then the longest.

    Many names share them, up to a separator; or most of all names begin so.
    """
    count: dict[str, int] = {}
    for name in names:
        ends = {m.end() for m in _SEPARATORS.finditer(name) if m.end() < len(name)}
        for end in ends:
            count[name[:end]] = count.get(name[:end], 0) + 1
    out = [p for p, n in count.items() if n >= _MANY]
    often = sorted(names)
    few = len(often) - int(_MOST * len(often))  # others, at most, on either side
    for k in range(few + 1 if len(often) >= _MANY else 0):
        shared = _shared(often[k], often[-1 - few + k])
        longest = max((len(p) for p in count if shared.startswith(p)), default=0)
        if len(shared) > longest + 2:
            out.append(shared)
    return ["", *sorted(dict.fromkeys(out), key=lambda p: (-len(p), p))]


def _shared(a: str, b: str) -> str:
    """Common prefix of both."""
    pairs = enumerate(zip(a, b, strict=False))
    return a[: next((k for k, (x, y) in pairs if x != y), min(len(a), len(b)))]


def read_names(names: Mapping[str, int]) -> tuple[dict[str, dict[str, int]], dict]:
    """Columns by side and word, `` for those of no side, and by plain name.

    Where two names say the same, the one that says it more plainly counts.
    """
    plain: dict[str, int] = {}
    said: dict[str, dict[str, int]] = {"L": {}, "R": {}, "": {}}
    readings: list[tuple[int, int, str, str]] = []
    for name, column in names.items():
        plain.setdefault(plain_name(name), column)
        for rank, (side, word) in enumerate(_readings(name)):
            if word in _WORDS:
                readings.append((rank, column, side, word))
                break
    for _, column, side, word in sorted(readings):
        said[side].setdefault(word, column)
    said[""] = {**said[""], **{w: c for w, c in plain.items() if w not in said[""]}}
    for words in (said["L"], said["R"]):
        _call_thigh(words)
    return said, plain


def _call_thigh(words: dict[str, int]) -> None:
    """A `leg` beside a shin, and no thigh: it is the thigh."""
    shin = {"shin", "shank", "calf", "lowerleg", "tibia"}
    if "leg" in words and shin & words.keys() and not words.keys() & {*JOINTS["Hip"]}:
        words["thigh"] = words.pop("leg")


def _readings(name: str) -> list[tuple[str, str]]:
    """Side and word, as a name may be understood, the plainest first."""
    pieces = [t for t in _SEPARATORS.split(name) if t]
    out = _sided(pieces)
    if pieces and pieces[0][:1] == "j" and (len(pieces[0]) == 1 or _is_capital(pieces)):
        rest = [pieces[0][1:], *pieces[1:]]
        out += _sided([t for t in rest if t])
    kept = list(pieces)
    while len(kept) > 1 and kept[-1].lower() in _IDLE:
        kept.pop()
    if len(kept) < len(pieces):
        out += _sided(kept)
    out += [("", "".join(p).lower()) for p in (pieces, kept)]
    out += [(side, _FIRST.sub("", word)) for side, word in out if _FIRST.search(word)]
    return out


def _is_capital(pieces: Sequence[str]) -> bool:
    return pieces[0][1:2].isupper()


def _sided(pieces: Sequence[str]) -> list[tuple[str, str]]:
    """Readings of the pieces of a name."""
    out: list[tuple[str, str]] = []
    joined = "".join(pieces).lower()
    for k in (0, len(pieces) - 1, *range(1, len(pieces) - 1)):
        if len(pieces) > 1 and (side := _SIDES.get(pieces[k].lower())):
            out.append((side, "".join([*pieces[:k], *pieces[k + 1 :]]).lower()))
    for word, side in (("left", "L"), ("right", "R")):
        if joined.startswith(word):
            out.append((side, joined.removeprefix(word)))
        if joined.endswith(word):
            out.append((side, joined.removesuffix(word)))
    if joined[:1] in ("l", "r"):
        out.append((joined[0].upper(), joined[1:]))
    camel = [c for p in pieces for c in _CAMEL.findall(p)]
    for k in range(1, len(camel)):
        if camel[k] in ("L", "R", "Left", "Right"):
            out.append((camel[k][0], "".join(camel[:k] + camel[k + 1 :]).lower()))
    return out


_WORDS = {
    *(w for words in JOINTS.values() for w in words),
    *(w.lstrip("*") for place in PLACES.values() for both in place for w in both),
}
