"""Equations of the pages as MathML, which browsers draw by themselves.

A hook of mkdocs: fenced blocks called `math` hold LaTeX, as on GitHub. Nothing is
fetched when a page is read, and no script runs.
"""

from __future__ import annotations

import re
from typing import Any

from latex2mathml.converter import convert


def mathml(source: str) -> str:
    """A displayed equation, from LaTeX.

    Raises:
        ValueError: It holds what the converter does not know.
    """
    # The converter has `aligned` under another name; browsers align by style alone.
    text = convert(source.strip().replace("{aligned}", "{split}"), display="block")
    text = re.sub(r'columnalign="(\w+)"', r'style="text-align: \1"', text)
    unknown = re.search(r"\\\w+|<mi>&(amp;)?</mi>", text)
    if unknown:
        raise ValueError(f"{unknown[0]} in the equation {source.strip()!r}")
    return text


def equation(source: str, *_args: object, **_options: object) -> str:
    """The same, as a block of a page."""
    return f'<div class="equation">{mathml(source)}</div>'


def on_config(config: Any) -> Any:
    """Have fenced blocks of `math` made into equations."""
    fences = config["mdx_configs"].setdefault("pymdownx.superfences", {})
    fences["custom_fences"] = [{"name": "math", "class": "math", "format": equation}]
    return config
