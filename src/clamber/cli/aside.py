"""Another process, which draws a run folder while this one goes on with physics."""

from __future__ import annotations

import contextlib
import signal
from collections.abc import Callable, Iterator
from concurrent.futures import BrokenExecutor, Future
from pathlib import Path
from typing import Any

import clamber

# Takes the folder and the options of `render_run`; pictures are files, not results.
Drawing = Callable[..., Future[None]]


@contextlib.contextmanager
def drawing_aside() -> Iterator[Drawing]:
    """What draws aside; the process begins to import at once, and is waited for."""
    # As sweeps do; it does not run the caller's script a second time, as spawn does.
    from joblib.externals.loky import ProcessPoolExecutor

    pool = ProcessPoolExecutor(1)
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
        pool.shutdown(wait=True, kill_workers=True)
        raise


def _prepare() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the one that waits says so
    from clamber.show import pictures, renderer

    del pictures
    renderer.gl_backend()


def _draw(folder: Path, options: dict[str, Any]) -> None:
    clamber.render_run(folder, with_video=False, **options)
