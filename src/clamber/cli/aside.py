"""Another process, which draws a run folder while this one goes on with physics."""

from __future__ import annotations

import contextlib
import multiprocessing
import signal
from collections.abc import Callable, Iterator
from concurrent.futures import BrokenExecutor, Future, ProcessPoolExecutor
from multiprocessing.reduction import ForkingPickler
from pathlib import Path
from types import MappingProxyType
from typing import Any

import clamber

# Takes the folder and the options of `render_run`; pictures are files, not results.
Drawing = Callable[..., Future[None]]


@contextlib.contextmanager
def drawing_aside() -> Iterator[Drawing]:
    """What draws aside; the process begins to import at once, and is waited for."""
    ForkingPickler.register(MappingProxyType, _of_mapping)
    pool = ProcessPoolExecutor(1, multiprocessing.get_context("spawn"))
    try:
        pool.submit(_prepare)

        def draw(folder: Path, **options: Any) -> Future[None]:
            try:
                return pool.submit(_draw, folder, options)
            except BrokenExecutor as e:  # it is told of where the picture is waited for
                broken: Future[None] = Future()
                broken.set_exception(e)
                return broken

        yield draw
        pool.shutdown(wait=True)
    except BaseException:
        for child in multiprocessing.active_children():
            child.terminate()
        pool.shutdown(wait=True, cancel_futures=True)
        raise


def _of_mapping(mapping: MappingProxyType) -> tuple[Callable, tuple[dict]]:
    return _mapping, (dict(mapping),)


def _mapping(content: dict) -> MappingProxyType:
    return MappingProxyType(content)


def _prepare() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the one that waits says so
    from clamber.show import pictures, renderer

    del pictures
    renderer.gl_backend()


def _draw(folder: Path, options: dict[str, Any]) -> None:
    clamber.render_run(folder, with_video=False, **options)
