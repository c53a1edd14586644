"""A film under new light, frame by frame.

What changes slowly is worked out at key frames and goes over from one to the next: the person's posterior, the film's
own light, the bust and its shadows, the skin and the exposure. What changes fast is seen in every frame: where the face
is, where the person ends, and the pixels.
"""

from __future__ import annotations

import ctypes
import gc
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from copy import copy
from functools import partial
from itertools import chain
from typing import NamedTuple

import torch
from torch import Tensor

from facerelight.geometry.sources import Lamp, LightMixture, scene_light
from facerelight.inference.methods import Method
from facerelight.inference.relighter import StatisticalRelighter
from facerelight.photo.compose import Changes, change_pixels
from facerelight.photo.film.evidence import Evidence, angle_between
from facerelight.photo.film.frame import FilmFrame, SteadyMatte
from facerelight.photo.film.keys import Key, between_keys, make_key
from facerelight.photo.film.lamps import MovingLamp, lamps_at, largest_step
from facerelight.photo.film.track import Choose, Picture, Tracked, follow, largest_face

__all__ = ["FilmRelighter", "Lighting"]

MOST_BETWEEN = 12  # frames from a key to the next
TURNED = 3.0  # degrees that a head turns from a key to the next
LAMP_MOVED = 3.0  # degrees that a lamp moves

Source = Lamp | LightMixture


class Lighting(NamedTuple):
    """The new light of a film: ``lamps`` that stand or move, ``fill`` and ``strength`` as for
    :func:`facerelight.relight`, and whether to ``add`` it to the film's own light."""

    lamps: Sequence[Source | MovingLamp]
    fill: float = 0.1
    strength: float = 1.0
    add: bool = False


class _Pending(NamedTuple):
    tracked: Tracked
    frame: FilmFrame
    lamps: list[Source]


class FilmRelighter:
    """Relights the frames of a film; memory holds a few frames, however long it is.

    Args:
        lighting: the new light.
        relighter: the model; None: the packaged one.
        method: see :class:`facerelight.photo.PhotoRelighter`.
        source_light: ``(3,)`` where the film's own light stands, if that is known.
        choose: the face that is meant; default: the largest whole one.

    Example:
        >>> film = FilmRelighter(Lighting([Lamp(60, 20)]))  # doctest: +SKIP
        >>> relit = [picture.pixels for picture in film.frames(pictures)]  # doctest: +SKIP
    """

    def __init__(
        self,
        lighting: Lighting,
        relighter: StatisticalRelighter | None = None,
        method: Method = "expected",
        source_light: Tensor | None = None,
        choose: Choose = largest_face,
    ) -> None:
        from facerelight.photo.face_model import load_relighter

        self.lighting, self.choose = lighting, choose
        self.relighter = relighter or load_relighter()
        self._known: tuple[Method, Tensor | None] = method, source_light
        self._begin()

    def _begin(self) -> None:
        self.seen = self.lit = self.keys = self.shots = 0
        self.warnings: dict[str, str] = {}  # the first of each kind
        self.source_angles: tuple[float, float] | None = None
        self._kept: dict[int, tuple[Evidence, SteadyMatte]] = {}

    def frames(self, pictures: Iterable[Picture]) -> Iterator[Picture]:
        """The ``pictures`` of one film relit, in their order; those without a face stay as they are. What was known of
        an earlier film is forgotten.

        Raises:
            ValueError: lights that cannot be used.
        """
        self._begin()
        threads = torch.get_num_threads()
        if threads < 2:
            for job in self._jobs(pictures):
                yield job()
            return
        with ThreadPoolExecutor(threads) as pool:  # frames are lit beside the search for the next ones
            begun: deque[Future[Picture]] = deque()
            for job in self._jobs(pictures):
                begun.append(pool.submit(job))
                while len(begun) > MOST_BETWEEN:
                    yield begun.popleft().result()
            while begun:
                yield begun.popleft().result()

    def _jobs(self, pictures: Iterable[Picture]) -> Iterator[Callable[[], Picture]]:
        """What gives each picture of the new film, in order."""
        waiting: list[_Pending] = []
        key: Key | None = None
        shaped, age = None, 0  # the frame whose bust is lit, and for how many frames it has been
        for tracked in chain(follow(pictures, self.choose), [None]):
            over = tracked is None or tracked.face is None or (waiting and tracked.run != waiting[-1].tracked.run)
            if over and waiting:
                assert key is not None
                last = key
                if len(waiting) > 1:
                    last = make_key(waiting[-1].frame, self._light(waiting[-1]))
                    self.keys += 1
                yield from self._between(waiting, key, last, len(waiting) - 1)
                waiting, key, shaped = [], None, None
            if tracked is None:
                break
            self.seen, self.shots = self.seen + 1, tracked.shot + 1
            if tracked.face is None:
                yield partial(Picture, *tracked.picture)
                continue
            self.lit += 1
            lamps = lamps_at(self.lighting.lamps, tracked.picture.time)
            anew = shaped is None or age >= MOST_BETWEEN or self._turned(shaped, tracked)
            waiting.append(_Pending(tracked, self._frame(tracked, anew), lamps))
            shaped, age = (waiting[-1], 1) if anew else (shaped, age + 1)
            if anew:
                _give_back_memory()
            if anew or largest_step(waiting[0].lamps, lamps) > LAMP_MOVED:
                assert shaped is not None
                made = make_key(shaped.frame, self._light(waiting[-1]))
                self.keys += 1
                if key is not None:
                    yield from self._between(waiting[:-1], key, made, len(waiting) - 1)
                waiting, key = waiting[-1:], made

    def _between(self, waiting: list[_Pending], one: Key, two: Key, steps: int) -> Iterator[Callable[[], Picture]]:
        """What gives the frames from key ``one`` on, ``steps`` before key ``two``."""
        for k, pending in enumerate(waiting):
            yield partial(self._relit, pending, one, two, k / max(steps, 1))

    @torch.inference_mode()
    def _relit(self, pending: _Pending, one: Key, two: Key, share: float) -> Picture:
        tracked, frame, _ = pending
        light = between_keys(frame, one, two, share)
        person = copy(frame.person)  # a key's own stays for the keys to come
        person.skin = light.skin
        log_ratio = person.follow(light.log_ratio, light.exposure)
        strength = self.lighting.strength * tracked.share
        changes = Changes(log_ratio, light.skin, person.cover, person.ground, light.change, strength)
        return tracked.picture._replace(pixels=change_pixels(tracked.picture.pixels, frame.window, changes))

    def _frame(self, tracked: Tracked, key: bool) -> FilmFrame:
        assert tracked.face is not None
        if tracked.run not in self._kept:  # another face may be another person
            self._kept = {tracked.run: (Evidence(self.relighter, *self._known), SteadyMatte())}
        evidence, steady = self._kept[tracked.run]
        frame = FilmFrame(tracked.picture.pixels, tracked.face, evidence, steady, key)
        if key:
            for line in frame.warnings:
                self.warnings.setdefault(line.split(":")[0], f"from {tracked.picture.time:.1f} s on, {line}")
            self.source_angles = self.source_angles or frame.source_angles
        return frame

    def _light(self, pending: _Pending) -> LightMixture:
        own = [pending.frame.light] if self.lighting.add else []
        return scene_light([*own, *pending.lamps], self.lighting.fill)

    def _turned(self, shaped: _Pending, tracked: Tracked) -> bool:
        """Whether the head stands so differently that its bust is made anew."""
        poses = [one.face.pose for one in (shaped.tracked, tracked) if one.face is not None]
        if len(poses) < 2 or poses[0] is None or poses[1] is None:
            return True
        return angle_between(poses[0].rotation, poses[1].rotation) > TURNED


def _give_back_memory() -> None:
    """What was freed goes back to the system: the allocator of Linux keeps it, in pieces that fit no new map."""
    gc.collect()
    with suppress(AttributeError, OSError, TypeError):
        ctypes.CDLL(None).malloc_trim(0)
