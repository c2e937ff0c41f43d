"""Another process, which draws a run folder while this one goes on with physics."""

from __future__ import annotations

import contextlib
import multiprocessing
import signal
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from multiprocessing.reduction import ForkingPickler
from pathlib import Path
from types import MappingProxyType
from typing import Any

import clamber

# Takes the folder and the options of `render_run`; pictures are files, not results.
Drawing = Callable[..., Future[None]]


def _read_only(content: dict) -> MappingProxyType:
    return MappingProxyType(content)


# Records hold mappings that nobody can write to.
ForkingPickler.register(MappingProxyType, lambda m: (_read_only, (dict(m),)))


@contextlib.contextmanager
def drawing_aside() -> Iterator[Drawing]:
    """What draws aside; the process begins to import at once, and is waited for."""
    spawn = multiprocessing.get_context("spawn")  # there may be threads in this one
    with ProcessPoolExecutor(1, mp_context=spawn) as pool:
        pool.submit(_prepare)  # a pool starts its processes with the first task

        def draw(folder: Path, **options: Any) -> Future[None]:
            return pool.submit(_draw, folder, options)

        try:
            yield draw
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise


def _prepare() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the one that waits says so
    from clamber.show import pictures, renderer

    del pictures
    renderer.gl_backend()


def _draw(folder: Path, options: dict[str, Any]) -> None:
    clamber.render_run(folder, with_video=False, **options)
