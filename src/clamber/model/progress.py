"""How far a long job has come: who does it reports, who asked for it shows."""

from __future__ import annotations

from collections.abc import Callable

Progress = Callable[[str, float, str], None]  # stage, share of it, what is being done


def silent(stage: str, share: float, note: str) -> None:
    """Report progress to nobody."""
