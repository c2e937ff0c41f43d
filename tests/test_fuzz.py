"""Whatever a recording's file holds, the answer is points or one of our own errors.

Files are mutated copies of good ones, and bytes that hypothesis makes up. Time and
memory are watched: a hang is more than 5 s, too much is ten times the file.
"""

from __future__ import annotations

import functools
import io
import time
import tracemalloc
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from clamber.errors import InputError
from clamber.model.boxes import read_obj
from clamber.recording import arrays
from clamber.recording.demonstration import Demonstration
from clamber.recording.recording import load_demo, read_points
from support.climb import ClimbOptions, synthesize_climb
from support.files import (
    MOTIVE,
    box_obj,
    bvh_text,
    c3d_bytes,
    motive_csv,
    renamed,
    smpl_joints,
    trc_text,
)

SLOWEST = 5.0  # [s] of the processor
LARGEST = 10  # times the file
FIXED = 2 << 20  # [byte] for what does not depend on the file
SUFFIXES = ("c3d", "trc", "csv", "bvh", "npy", "npz")


@functools.cache
def short() -> Demonstration:
    options = ClimbOptions(rate=60.0, speed=12.0, gaps=0)
    return synthesize_climb(np.random.default_rng(2), options=options)[0]


@functools.cache
def good(suffix: str) -> tuple[bytes, ...]:
    """Whole files of the format, in as many dialects as there are."""
    demo = short()
    p = demo.position
    names = list(demo.names)
    out = io.BytesIO()
    if suffix == "npy":
        np.save(out, smpl_joints(demo, 22).astype(np.float32))
        return (out.getvalue(),)
    if suffix == "npz":
        np.savez(out, positions=p, names=names, rate=60.0)
        packed = io.BytesIO()
        np.savez_compressed(packed, positions=p, names=names, rate=60.0)
        return out.getvalue(), packed.getvalue()
    if suffix == "csv":
        called = renamed(demo, MOTIVE)
        q = np.tile([1.0, 0, 0, 0], (*p.shape[:2], 1))
        return (
            motive_csv(called, p, rate=60.0).encode(),
            motive_csv(called, p, rate=60.0, quaternion=q, parent=True).encode(),
        )
    if suffix == "bvh":
        return (bvh_text(demo, 100 * p, "ZXY").encode(),)
    if suffix == "trc":
        return (trc_text(1000.0 * p, names, 60.0).encode(),)
    if suffix == "obj":
        text = box_obj([1, 2, 0.5], [0, 0, 0.25], 0.3, name="step")
        return ((text + box_obj([1, 1, 1], [3, 0, 0.5], 0.0)).encode(),)
    return tuple(
        c3d_bytes(1000.0 * p, names, order=order, scale=scale, analog=3)
        for order in ("intel", "dec", "mips")
        for scale in (-1.0, 0.1)
    )


WORDS = [
    b"nan", b"inf", b"-1", b"0", b"1e308", b"99999999999", b"\t", b",", b"\n", b"}",
    b"{", b"\x00", b"\xff", b"JOINT x\n{\n", b"\x7f\xff\xff\xff", b"\x80\x00", b'"',
]  # fmt: skip


def mutate(raw: bytes, rng: np.random.Generator) -> bytes:
    """A few random damages, more often near the beginning, where headings are."""
    b = bytearray(raw)
    for _ in range(int(rng.integers(1, 4))):
        if not b:
            break
        near = len(b) if rng.random() < 0.3 else min(len(b), 3000)
        at = int(rng.integers(near))
        match int(rng.integers(8)):
            case 0:
                b[at] = int(rng.integers(256))
            case 1:
                del b[at : at + int(rng.integers(1, 200))]
            case 2:
                b[at:at] = WORDS[int(rng.integers(len(WORDS)))]
            case 3:
                word = WORDS[int(rng.integers(len(WORDS)))]
                b[at : at + len(word)] = word
            case 4:
                del b[int(rng.integers(len(b))) :]
            case 5:
                piece = b[at : at + int(rng.integers(1, 400))]
                there = int(rng.integers(len(b)))
                b[there:there] = piece
            case _:  # another digit: the file stays whole
                digits = [k for k in range(at, min(at + 50, len(b))) if 48 <= b[k] < 58]
                for k in digits[:3]:
                    b[k] = 48 + int(rng.integers(10))
    return bytes(b)


def survives(read: Callable[[Path], object], path: Path, raw: bytes) -> bool:
    """Whether it was read; fails on a crash, a hang or an error that says nothing."""
    path.write_bytes(raw)
    began = time.process_time()
    said = None
    try:
        read(path)
    except InputError as e:
        said = str(e)
    assert time.process_time() - began < SLOWEST
    if said is not None:
        assert str(path) in said
        assert "expected" in said
        assert "\n" not in said
    return said is None


def peak_memory(call: Callable[[], object]) -> int:
    """Most bytes that were held at once during a call."""
    tracemalloc.start()
    try:
        call()
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize("suffix", [*SUFFIXES, "obj"])
@pytest.mark.parametrize(
    "many", [100, pytest.param(3000, marks=pytest.mark.slow)], ids=["quick", "slow"]
)
def test_mutated_files_are_read_or_refused(tmp_path, suffix, many):
    files, path = good(suffix), tmp_path / f"a.{suffix}"
    read = read_obj if suffix == "obj" else functools.partial(load_demo, rate=60.0)
    rngs = (
        np.random.default_rng([k, len(suffix), ord(suffix[0])]) for k in range(many)
    )
    whole = sum(
        survives(read, path, mutate(files[k % len(files)], rng))
        for k, rng in enumerate(rngs)
    )
    assert 0 < whole < many, "the mutations are too mild or too wild"


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_no_reader_takes_more_memory_than_ten_times_the_file(tmp_path, suffix):
    files = good(suffix)
    path = tmp_path / f"a.{suffix}"
    read_first = functools.partial(read_points, rate=60.0)
    survives(read_first, path, files[0])  # imports and caches come first
    for k in range(30):
        raw = mutate(files[k % len(files)], np.random.default_rng([k, 5]))
        peak = peak_memory(lambda raw=raw: survives(read_first, path, raw))
        assert peak < LARGEST * len(raw) + FIXED


MAGIC = {
    "c3d": b"\x02\x50", "trc": b"PathFileType\t4\n", "csv": b"Format Version,1.23\n",
    "bvh": b"HIERARCHY\nROOT a\n{\n", "npy": b"\x93NUMPY\x01\x00", "npz": b"PK\x03\x04",
}  # fmt: skip


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_bytes_that_anybody_makes_up_are_refused(tmp_path, suffix):
    path = tmp_path / f"a.{suffix}"

    @settings(
        max_examples=100, deadline=None, derandomize=True, database=None,
        suppress_health_check=list(HealthCheck),
    )  # fmt: skip
    @given(st.binary(max_size=3000), st.booleans())
    def check(raw: bytes, begins_well: bool) -> None:
        survives(read_points, path, MAGIC[suffix] * begins_well + raw)

    check()


CELLS = st.one_of(
    st.floats(width=32).map(repr), st.integers(-5, 5).map(str),
    st.sampled_from(["", " ", "nan", "x", "1_0", "0x1", "1,5", "\u0661", "-", "1e999"]),
)  # fmt: skip


@pytest.mark.parametrize("suffix", ["trc", "csv", "bvh"])
def test_tables_of_any_cells_are_read_or_the_line_is_named(tmp_path, suffix):
    heads = {
        "trc": "PathFileType\t4\tx\nDataRate\tNumMarkers\tUnits\n60\t1\tmm\n"
        "Frame#\tTime\tA\n\t\tX1\tY1\tZ1\n",
        "csv": "Format Version,1.23,Export Frame Rate,60\n\n,Type,Bone,Bone,Bone\n"
        ",Name,A,A,A\n,,Position,Position,Position\nFrame,Time,X,Y,Z\n",
        "bvh": "HIERARCHY\nROOT A\n{\nOFFSET 0 0 0\nCHANNELS 5 Xposition Yposition "
        "Zposition Xrotation Yrotation\n}\nMOTION\nFrames: 2\nFrame Time: 0.01\n",
    }  # fmt: skip
    gap = {"trc": "\t", "csv": ",", "bvh": " "}[suffix]
    path = tmp_path / f"a.{suffix}"

    @settings(
        max_examples=100, deadline=None, derandomize=True, database=None,
        suppress_health_check=list(HealthCheck),
    )  # fmt: skip
    @given(st.lists(st.lists(CELLS, min_size=4, max_size=6), min_size=1, max_size=4))
    def check(rows: list[list[str]]) -> None:
        text = heads[suffix] + "\n".join(gap.join(r) for r in rows)
        path.write_bytes(text.encode())
        said = ""
        try:
            points = read_points(path)
        except InputError as e:
            said = str(e)
        else:
            assert points.position.shape[1:] == (1, 3)
            assert not np.isinf(points.position).any()
        assert not said or "line" in said or "sample" in said

    check()


# Known tricks.


def test_pickles_are_refused(tmp_path):
    objects = np.array([print, None], dtype=object)
    np.save(tmp_path / "a.npy", objects, allow_pickle=True)
    np.savez(tmp_path / "b.npz", positions=objects, allow_pickle=True)
    for name in ("a.npy", "b.npz"):
        with pytest.raises(InputError, match="without pickled objects"):
            load_demo(tmp_path / name, names=["a"], rate=60)


def test_an_archive_that_unpacks_to_too_much_is_refused_before(tmp_path, monkeypatch):
    monkeypatch.setattr(arrays, "MAX_BYTES", 10_000_000)
    path = tmp_path / "bomb.npz"
    np.savez_compressed(path, positions=np.zeros((20_000, 100, 3)), rate=60.0)

    def refuse() -> None:
        with pytest.raises(InputError, match="at most 10000000 bytes"):
            load_demo(path)

    assert peak_memory(refuse) < FIXED


def test_an_archive_that_lies_about_its_size_is_refused(tmp_path):
    inner = io.BytesIO()
    np.save(inner, np.zeros((20_000, 100, 3)))
    path = tmp_path / "liar.npz"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("positions.npy", inner.getvalue())
    raw = bytearray(path.read_bytes())
    size = len(inner.getvalue()).to_bytes(4, "little")
    small = (1000).to_bytes(4, "little")
    path.write_bytes(bytes(raw).replace(size, small))
    with pytest.raises(InputError):
        load_demo(path, rate=60)


@pytest.mark.parametrize(
    "shape", ["(1000000000, 20, 3)", "(-1, 20, 3)", "(2**60, 9, 3)"]
)
def test_a_header_that_claims_more_than_there_is_is_refused(tmp_path, shape):
    text = f"{{'descr': '<f8', 'fortran_order': False, 'shape': {shape}, }}"
    head = text.encode().ljust(117) + b"\n"
    raw = b"\x93NUMPY\x01\x00" + len(head).to_bytes(2, "little") + head + b"\0" * 64
    (tmp_path / "a.npy").write_bytes(raw)

    def refuse() -> None:
        with pytest.raises(InputError, match=r"a\.npy"):
            load_demo(tmp_path / "a.npy", rate=60)

    assert peak_memory(refuse) < FIXED


def test_a_hierarchy_of_any_depth_is_no_trouble(tmp_path):
    deep = 5000
    text = "HIERARCHY\nROOT a\n{\nOFFSET 0 0 0\nCHANNELS 1 Xrotation\n"
    text += "JOINT b\n{\nOFFSET 0 0 1\nCHANNELS 1 Xrotation\n" * deep + "}\n" * (
        deep + 1
    )
    row = " ".join(["0"] * (deep + 1)) + "\n"
    text += f"MOTION\nFrames: 2\nFrame Time: 0.01\n{row}{row}"
    (tmp_path / "a.bvh").write_text(text)
    points = read_points(tmp_path / "a.bvh")
    assert points.position[1, -1].tolist() == [0, 0, deep]


@pytest.mark.parametrize("suffix", ["trc", "bvh"])
def test_a_table_cut_short_is_read_and_says_so(tmp_path, suffix):
    raw = good(suffix)[0]
    (tmp_path / f"a.{suffix}").write_bytes(raw[: raw[:-1].rindex(b"\n") + 1])
    points = read_points(tmp_path / f"a.{suffix}")
    rows = len(short().t) - 1
    assert len(points.position) == rows
    assert f"the file has {rows} rows" in points.notes[0]


def test_a_c3d_cut_in_half_says_where_it_ends(tmp_path):
    raw = good("c3d")[0]
    (tmp_path / "a.c3d").write_bytes(raw[: len(raw) // 2])
    with pytest.raises(InputError, match="the file ends after") as e:
        read_points(tmp_path / "a.c3d")
    assert e.value.field == f"byte {len(raw) // 2}"


EXPORT = "line 1, export frame rate"


@pytest.mark.parametrize(
    ("suffix", "old", "new", "field"),
    [
        ("trc", b"\n7\t", b"\n5\t", "line 13"),
        ("csv", b"Export Frame Rate,60", b"Export Frame Rate,x", EXPORT),
        ("csv", b"Frame,Time", b"Frome,Time", "line 12"),
        ("csv", b"\n72213,", b"\n72213,,", "line 11"),
        ("csv", b"\n72213,", b"\n72213,x", "line 11, cell 2"),
        ("bvh", b"Frame Time: 0.01", b"Frame Time: -0.01", "frame time"),
        ("bvh", b"CHANNELS 6", b"CHANNELS 5", "line 5"),
        ("bvh", b"Xposition", b"Wposition", "line 5"),
        ("bvh", b"OFFSET 0.0 0.0 0.0", b"OFFSET 0.0 zero 0.0", "line 4"),
    ],
)  # fmt: skip
def test_where_a_file_is_wrong_is_said(tmp_path, suffix, old, new, field):
    raw = good(suffix)[0]
    assert old in raw
    path = tmp_path / f"a.{suffix}"
    path.write_bytes(raw.replace(old, new, 1))
    with pytest.raises(InputError) as e:
        read_points(path)
    if field == "frame time":
        field = f"line {raw[: raw.index(old)].count(10) + 1}"
    assert e.value.field == field
