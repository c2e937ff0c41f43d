"""What is said of a wrong input, and what it costs to be able to say it."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import dataclass

import pytest

from clamber.errors import InputError, read_yaml, validated


@dataclass(frozen=True, kw_only=True)
class Wanted:
    speed: float
    parts: tuple[int, int] | tuple[int, int, int] = (1, 2)


@pytest.mark.parametrize(
    ("given", "sentence"),
    [
        (("a number",), "a number"),
        (("a number", "a.yaml"), "a.yaml: expected a number"),
        (("a number", "a.yaml", "x.y"), "a.yaml: x.y: expected a number"),
        (("a number", "a.yaml", "x.y", "b"), "a.yaml: x.y is 'b'; expected a number"),
        (("a number", "--x", None, "b"), "--x is 'b'; expected a number"),
        (("a number", "a.yaml", "x\ny"), r"a.yaml: 'x\ny': expected a number"),
    ],
)
def test_an_input_error_names_what_it_knows_in_one_sentence(given, sentence):
    assert str(InputError(*given)) == sentence


@pytest.mark.parametrize(
    ("content", "field", "value"),
    [
        ({"speed": "fast"}, "speed", "fast"),
        ({}, "speed", None),
        ({"speed": 1.0, "colour": "red"}, "colour", "red"),
        ({"speed": 1.0, "parts": [1, "b"]}, "parts.1", "b"),
    ],
)
def test_a_field_that_is_wrong_is_named(content, field, value):
    import pydantic

    strict = pydantic.with_config(extra="forbid")(Wanted)
    with pytest.raises(InputError) as caught:
        validated(strict, content, "a.yaml")
    assert caught.value.source == "a.yaml"
    assert (caught.value.field, caught.value.value) == (field, value)
    assert validated(strict, {"speed": 2}, "a.yaml").speed == 2.0


@pytest.mark.parametrize("text", ["a: [1\n", "- 1\n", "", "\x00"])
def test_a_file_that_is_no_mapping_is_named(tmp_path, text):
    path = tmp_path / "a.yaml"
    path.write_text(text)
    with pytest.raises(InputError) as caught:
        read_yaml(path)
    assert caught.value.source == path
    assert "\n" not in str(caught.value)


def test_who_only_catches_errors_loads_no_library():
    code = "import sys, clamber.errors; print(*sys.modules)"
    out = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    assert not {"pydantic", "yaml", "numpy"} & set(out.stdout.split())
