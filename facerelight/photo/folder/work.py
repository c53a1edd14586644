"""Photos relit one after the other, here or in several processes that each load the model once."""

from __future__ import annotations

import gc
import multiprocessing
import os
import signal
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from facerelight.photo.batch import Job, Load, Request, relight_photo

if TYPE_CHECKING:
    from facerelight.inference.relighter import StatisticalRelighter

__all__ = ["Model", "Outcome", "relight_jobs"]


class Model(NamedTuple):
    """What a process loads: the ``statistics`` of a folder, taken as ``covariance`` says."""

    statistics: Path
    covariance: str


class Outcome(NamedTuple):
    """What became of a job: an exit ``code``, 0 where it was done; the ``report``, with an ``error`` where it was not;
    the lines that its user is to see."""

    job: Job
    code: int
    report: dict[str, Any]
    said: list[str]


def relight_jobs(jobs: Sequence[Job], request: Request, load: Load, model: Model, workers: int) -> Iterator[Outcome]:
    """Relight every job, and say of each what became of it, in the order in which they end.

    Args:
        jobs: their outputs differ.
        request: what is wanted of each.
        load: gives the relighter to this process.
        model: what the others load.
        workers: processes; 1 is this one alone. The machine's cores are shared out among them.

    Raises:
        RuntimeError: a process died, as it does where memory ends.
    """
    if min(workers, len(jobs)) < 2:
        yield from (_outcome(job, request, load) for job in jobs)
        return
    threads = max(1, (os.cpu_count() or 1) // workers)
    context = multiprocessing.get_context("spawn")  # threads of torch do not survive a fork
    pool = ProcessPoolExecutor(min(workers, len(jobs)), context, _begin, (threads,))
    try:
        for future in as_completed([pool.submit(_work, job, request, model) for job in jobs]):
            yield future.result()
    except BrokenProcessPool as error:
        raise RuntimeError("workers: one of them died; fewer --workers need less memory, --resume goes on") from error
    finally:
        pool.shutdown(cancel_futures=True)


def _outcome(job: Job, request: Request, load: Load) -> Outcome:
    from facerelight.photo.faces.landmarks import LandmarksNotFoundError

    said: list[str] = []
    try:
        return Outcome(job, 0, relight_photo(job, request, load, said.append), said)
    except (ValueError, OSError, LandmarksNotFoundError) as error:
        code = 1 if isinstance(error, LandmarksNotFoundError) else 2
        return Outcome(job, code, {"photo": str(job.photo), "error": str(error)}, [*said, str(error)])
    finally:
        gc.collect()  # a session's maps are many megabytes, and some of them hold each other


@lru_cache(maxsize=1)
def _loaded(model: Model) -> StatisticalRelighter:
    """Of a worker process: read with its first photo, and kept."""
    from facerelight.inference.relighter import StatisticalRelighter

    return StatisticalRelighter.from_pretrained(model.statistics, model.covariance)  # type: ignore[arg-type]


def _begin(threads: int) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the process that shares out the work stops the others
    import cv2
    import torch

    torch.set_num_threads(threads)
    cv2.setNumThreads(threads)


def _work(job: Job, request: Request, model: Model) -> Outcome:
    return _outcome(job, request, lambda: _loaded(model))
