"""Learn statistics from a rendered bootstrap: the loop that ``facerelight train`` and ``scripts/train_statistics.py``
share."""

from __future__ import annotations

import json
import os
import shutil
import sys
import time
from collections import Counter
from contextlib import nullcontext
from dataclasses import asdict
from itertools import islice
from pathlib import Path

import torch
from torch import distributed
from torch.utils.data import DataLoader, Subset
from tqdm import tqdm

from facerelight.config import TrainConfig, default_statistics_folder, find_statistics
from facerelight.inference.relighter import StatisticalRelighter
from facerelight.light.kernel import KernelIlluminationEstimator
from facerelight.model.image_store import ImageStore
from facerelight.model.statistics import FaceStatistics
from facerelight.train.adapt import Person, adapt, read_people
from facerelight.train.cross_validation import choose_face_options
from facerelight.train.dataset import make_dataset
from facerelight.train.lock import locked

__all__ = ["rendered_statistics", "train", "trained_folder"]


def train(
    config: TrainConfig,
    folder: str | Path,
    workers: int = 2,
    keep_images: bool = False,
    adapt_to: str | Path | None = None,
) -> dict[str, object]:
    """Render the bootstrap, learn the statistics and the light estimator, and save them into ``folder``.

    A run that was interrupted goes on from the last finished head: each head's images are a file in ``folder/images``
    until the end. Under ``torchrun --nproc-per-node N -m facerelight.cli train`` the processes share the heads out
    among themselves.

    Args:
        config: what to learn.
        folder: where ``statistics.safetensors``, ``estimator.safetensors`` and ``report.json`` go.
        workers: processes that render; 0 renders in this one.
        keep_images: leave the rendered images where they are.
        adapt_to: a folder of a few people's photographs, see :func:`facerelight.train.adapt.read_people`; None:
            rendered heads alone.

    Returns:
        The report: sizes, kernel width, seconds, peak memory, and passes and pixels run and skipped by effect.
    """
    folder = Path(folder)
    # First, so that a bad photo is known before the rendering.
    people = read_people(adapt_to, config.frame) if adapt_to else []
    rank, processes = _join_processes()
    with locked(folder) if rank == 0 else nullcontext():
        return _train(config, folder, workers, keep_images, people, rank, processes)


def _train(
    config: TrainConfig,
    folder: Path,
    workers: int = 2,
    keep_images: bool = False,
    people: list[Person] | None = None,
    rank: int = 0,
    processes: int = 1,
) -> dict[str, object]:
    """:func:`train` in a folder that is held, as process number ``rank``; ``people`` are whom to adapt to."""
    if rank == 0:
        _start_images(folder, config)
    _wait(processes)
    started = time.perf_counter()
    dataset = make_dataset(config)
    statistics = FaceStatistics(config.directions(), config.fit, ImageStore(folder / "images"))
    assert statistics.store is not None
    todo = [index for index in range(rank, config.heads, processes) if index not in statistics.store]
    workers = min(workers, len(todo)) if processes == 1 else 0
    loader = DataLoader(
        Subset(dataset, todo),
        batch_size=None,
        num_workers=workers,
        collate_fn=_as_is,
        worker_init_fn=_one_thread,
        multiprocessing_context="spawn" if workers else None,
    )
    work: Counter[str] = Counter()
    for subject, images, done in tqdm(loader, desc="rendering heads", disable=not sys.stderr.isatty() or rank > 0):
        statistics.update(images, subject=int(subject))
        work.update(done)
    dataset.close()
    _wait(processes)
    rendered = time.perf_counter()
    if rank > 0:  # the first process solves: the images of all are files in one folder
        _wait(processes)
        return {"process": rank, "heads": len(todo), "render_seconds": round(rendered - started, 1)}
    if config.choose_rank:
        print("choosing rank and temper", file=sys.stderr)
        every = torch.stack([torch.from_numpy(array.copy()) for array in statistics.store])
        statistics.options = choose_face_options(every, statistics.lights, options=config.fit).options
    print(f"solving statistics of {config.heads} heads", file=sys.stderr)
    statistics.solve()
    images = torch.stack([torch.from_numpy(array.copy()) for array in islice(statistics.store, 60)])
    inside = ((1 - config.frame.oval()) / 0.1).clamp(0, 1)
    estimator = KernelIlluminationEstimator.fit(images, statistics.lights, weight=inside)
    if people:
        print(f"adapting them to {len(people)} people", file=sys.stderr)
        statistics = adapt(statistics, people, estimator)
    statistics.metadata |= {
        "config": asdict(config),
        "source": f"rendered heads ({config.source})",
        "radiance": "linear",
    }
    StatisticalRelighter(statistics, estimator=estimator).save_pretrained(folder)
    if not keep_images:
        shutil.rmtree(folder / "images")
    report: dict[str, object] = {
        **statistics.describe(),
        "heads": config.heads,
        "adapted_to": len(people or []),
        "render_seconds": round(rendered - started, 1),
        "solve_seconds": round(time.perf_counter() - rendered, 1),
        **_peak_memory(),
        "work": dict(sorted(work.items())),
    }
    (folder / "report.json").write_text(json.dumps(report, indent=2))
    _wait(processes)
    return report


def trained_folder(config: TrainConfig) -> Path:
    """The packaged or cached statistics of ``config``; trained now, and said so, where there are none yet."""
    found = find_statistics(config)
    if found is not None:
        return found
    folder = default_statistics_folder(config)
    with locked(folder):
        if find_statistics(config) is None:  # nor has another process trained them meanwhile
            print(f"no statistics in {folder} yet: training them once (a minute or two)", file=sys.stderr)
            _train(config, folder)
    return folder


def rendered_statistics(config: TrainConfig) -> FaceStatistics:
    """Statistics of ``config`` that still keep their images, as :func:`facerelight.train.adapt.adapt` needs them;
    rendered once and cached."""
    folder = default_statistics_folder(config)
    with locked(folder):
        store = ImageStore(folder / "images")
        if not all(index in store for index in range(config.heads)):  # what an interrupted run left is not enough
            _train(config, folder, keep_images=True)
        return FaceStatistics(config.directions(), config.fit, store).solve()


def _start_images(folder: Path, config: TrainConfig) -> None:
    """Make sure that images left by an earlier run belong to the same config."""
    folder.mkdir(parents=True, exist_ok=True)
    marker = folder / "config.json"
    text = json.dumps(config.identity(), indent=2, sort_keys=True)
    if marker.exists() and marker.read_text() != text:
        raise ValueError(f"{folder}: holds a run of another config; choose another folder or remove it")
    marker.write_text(text)


def _join_processes() -> tuple[int, int]:
    """Rank and number of processes under ``torchrun``; 0 and 1 without it. Each of several is held to one thread."""
    processes = int(os.environ.get("WORLD_SIZE", "1"))
    if processes == 1:
        return 0, 1
    if not distributed.is_initialized():
        distributed.init_process_group("gloo")
    _one_thread(0)
    return distributed.get_rank(), processes


def _wait(processes: int) -> None:
    """Until all processes are here."""
    if processes > 1:
        distributed.barrier()


def _one_thread(_: int) -> None:
    """Workers share the cores among themselves: one thread each, for torch and for the software renderer."""
    torch.set_num_threads(1)
    os.environ["LP_NUM_THREADS"] = "1"


def _peak_memory() -> dict[str, object]:
    """Of this process and of its workers; nothing where the system does not say (Windows)."""
    try:
        import resource
    except ImportError:
        return {}
    own, workers = (
        resource.getrusage(who).ru_maxrss / 1024 for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)
    )
    return {"peak_memory_mb": round(own), "worker_peak_memory_mb": round(workers)}


def _as_is(item: object) -> object:
    return item
