"""What a page has to know of a session to relight its photo: maps of face, bust and person, and how exactly each is
kept."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import torch

from facerelight.geometry import behind
from facerelight.geometry.sources import fill_light
from facerelight.numerics.luminance import LUMINANCE
from facerelight.photo import colour, compose, person, ratio
from facerelight.photo.bust import shading, surface
from facerelight.photo.bust.frame import BUST, FINE, Grid, crop_to_bust, smooth_step
from facerelight.photo.session import PhotoRelighter
from facerelight.photo.viewer.dome import compress_dome
from facerelight.photo.viewer.packing import Packed

__all__ = ["session_contents"]

FACE_RINGS, FACE_PLACES = 19, 48
FACE_BOUND = 0.002  # of light from 0 to 1, root mean square over face and dome
UNSURE_RINGS, UNSURE_PLACES, UNSURE_BOUND = 4, 8, 0.002
SMOOTH = 12.0  # pixels a unit of the maps of the skin's colours and the ground, which are averages over wider places
COARSEST = 4  # pixels of the fine grid that are one where the page draws in haste
ASIDE = 1.0  # units of the bust beyond the person that are kept
BYTE = 1 / 255
RADIANCE, HEIGHT, NORMAL, SHARE, COLOUR = 2**-11, 2**-12, 2**-10, 2**-14, 2**-10  # steps at which values are kept


@torch.inference_mode()
def session_contents(session: PhotoRelighter) -> tuple[dict[str, Packed], dict[str, Any]]:
    """Arrays, and facts for JSON.

    Maps lie on the model's crop (``face_``), on the window's copy (``copy_``), on a smaller copy (``small_``) and on
    the grids of ``photo.bust.frame`` (``bust_``, ``fine_``); matrices go from pixels of one to pixels of another.
    """
    kept = _kept(session)
    arrays = {**_face(session), **_unsure(session), **_bust(session, *kept), **_person(session)}
    return arrays, {**_places(session, *kept), **_light(session), "constants": _constants()}


def _face(session: PhotoRelighter) -> dict[str, Packed]:
    model = session.model
    from_head = np.ascontiguousarray(model.rotation.T.astype(np.float32))  # the dome is the head's own
    dome = compress_dome(lambda lights: model.radiance(lights @ from_head), FACE_RINGS, FACE_PLACES, FACE_BOUND)
    weight = smooth_step(np.clip((1 - session.frame.oval().numpy()) / 0.3, 0, 1))
    return {
        "face_basis": Packed(dome.basis, RADIANCE),
        "face_table": Packed(dome.table.transpose(2, 0, 1), SHARE),
        "face_luminance": Packed(model.luminance.numpy(), RADIANCE),
        "face_mask": Packed(model.mask.numpy(), BYTE),
        "face_trust": Packed(session._ratio.face.trust, BYTE),
        "face_weight": Packed(weight, BYTE),
        "face_normal": Packed(_flattened(model.normal), NORMAL),
    }


def _unsure(session: PhotoRelighter) -> dict[str, Packed]:
    model, mask = session.model, session.mask.numpy()
    from_head = model.rotation.T.astype(np.float32)
    dome = compress_dome(
        lambda lights: np.stack([model.std(light @ from_head) * mask for light in lights]),
        UNSURE_RINGS,
        UNSURE_PLACES,
        UNSURE_BOUND,
    )
    return {"unsure_basis": Packed(dome.basis, RADIANCE), "unsure_table": Packed(dome.table.transpose(2, 0, 1), SHARE)}


def _bust(session: PhotoRelighter, rows: slice, columns: slice) -> dict[str, Packed]:
    bust = session._ratio.shading.bust
    return {
        "bust_normal": Packed(_flattened(bust.normal), NORMAL),
        "bust_low": Packed(session._ratio.shading.low, HEIGHT),
        "fine_height": Packed(bust.fine, HEIGHT),
        "fine_normal": Packed(_flattened(bust.fine_normal[rows, columns]), NORMAL),
    }


def _flattened(normal: np.ndarray) -> np.ndarray:
    """Unit vectors ``(h, w, 3)`` towards the viewer on the plane, ``(2, h, w)``, by stereographic projection: as exact
    where the surface turns away as where it faces the camera."""
    return (normal[..., :2] / (1 + normal[..., 2:])).transpose(2, 0, 1)


def _person(session: PhotoRelighter) -> dict[str, Packed]:
    shown = session.person
    skin, seen = shown.skin, shown.cover > 0
    scale = min(1.0, SMOOTH / session.window.unit)
    size = tuple(max(2, round(side * scale)) for side in session.window.size[::-1])

    def small(image: np.ndarray) -> np.ndarray:
        return cv2.resize(image, size, interpolation=cv2.INTER_AREA).transpose(2, 0, 1)

    return {
        "copy_cover": Packed(shown.cover, BYTE),
        "copy_share": Packed(shown.brightened * seen, BYTE),
        "copy_eyeballs": Packed(shown.features.eyeballs * seen, BYTE),
        "copy_skin": Packed(skin.skin * seen, BYTE),
        "copy_lit": Packed(skin.lit * seen, BYTE),
        "copy_exposed": Packed(shown.sure_skin, BYTE),
        "small_diffuse": Packed(small(skin.diffuse), COLOUR),
        "small_cast": Packed(small(skin.cast), COLOUR),
        "small_ground": Packed(small(shown.ground), RADIANCE),
    }


def _kept(session: PhotoRelighter) -> tuple[slice, slice]:
    """Rows and columns of :data:`FINE` that show the person, and somewhat more."""
    seen = session.window.onto(session.person.cover, FINE, cv2.BORDER_CONSTANT) > 0
    if not seen.any():
        seen[...] = True
    found = []
    for along, size in zip((seen.any(1), seen.any(0)), FINE.size, strict=True):
        where, aside = np.flatnonzero(along), round(ASIDE * FINE.density)
        low, high = int(where[0]) - aside, int(where[-1]) + aside
        found.append(slice(max(0, low // COARSEST * COARSEST), min(size, (high // COARSEST + 1) * COARSEST)))
    return found[0], found[1]


def _places(session: PhotoRelighter, rows: slice, columns: slice) -> dict[str, Any]:
    window = session.window

    def grid(of: Grid) -> dict[str, Any]:
        return {"side": of.side, "top": of.top, "density": of.density, "size": of.size}

    return {
        "bust": grid(BUST),
        "fine": grid(FINE),
        "kept": [rows.start, rows.stop, columns.start, columns.stop],
        "crop_to_bust": crop_to_bust(session.frame).tolist(),
        "window": [int(end) for part in (window.rows, window.columns) for end in (part.start, part.stop)],
        "copy_to_bust": window.to_bust.tolist(),
        "rotation": session.model.rotation.tolist(),
    }


def _light(session: PhotoRelighter) -> dict[str, Any]:
    """The photo's own light, the fill's points at full strength, and how the photo is exposed."""
    own, fill, shown = session.light, fill_light(1.0), session.person
    luminance = shown.scene @ colour.LUMA
    skin = luminance[shown.sure_skin]
    azimuth, elevation = session.source_angles
    return {
        "own": {
            "directions": own.directions.tolist(),
            "weights": own.weights[:, 0].tolist(),
            "size": float(own.size[0]),
        },
        "fill": {"directions": fill.directions.tolist(), "weights": fill.weights[:, 0].tolist()},
        "dark": float(session._ratio.dark),
        "white": float(np.quantile(luminance, person.WHITE)),
        "exposed": float(np.quantile(skin, person.EXPOSED)) if len(skin) >= person.FEW else None,
        "typical": np.asarray(shown.skin.typical, float).tolist(),
        "source": [azimuth, elevation],
        "warnings": session.warnings,
    }


def _constants() -> dict[str, Any]:
    """Numbers of the modules that the page does over, so that they stand in one place."""
    modules = {"ratio": ratio, "shading": shading, "surface": surface, "person": person, "colour": colour}
    modules |= {"compose": compose, "behind": behind}
    numbers = {
        name: {key: value for key, value in vars(module).items() if key.isupper() and _plain(value)}
        for name, module in modules.items()
    }
    return {**numbers, "luminance": LUMINANCE}


def _plain(value: object) -> bool:
    return isinstance(value, int | float) or (
        isinstance(value, tuple) and all(isinstance(v, int | float) for v in value)
    )
