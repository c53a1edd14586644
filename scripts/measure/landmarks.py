"""How well the landmarks and poses of faces are found, on rendered heads with known truth; and the canonical face.

python scripts/measure/landmarks.py --json landmarks.json

Renders 200 heads under random lights, turned, tilted and scaled at random, finds them as in any photograph, and reports
the distance of eyes and mouth from those that the model's crops mean, in eye distances, and the errors of the pose in
degrees. With --canonical FILE.npz the mean positions of the 468 points and of the landmarks are measured on other heads
first, and written there: what facerelight/photo/networks/canonical_face.npz holds.
"""

import json
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from facerelight.bootstrap.dataset import open_renderer
from facerelight.bootstrap.domain import Domain
from facerelight.bootstrap.heads import MakeHumanHeads
from facerelight.bootstrap.look.hair import SHORN
from facerelight.bootstrap.look.skin import Look
from facerelight.bootstrap.posture import place_in_frame, rotate
from facerelight.bootstrap.shading import plan_effects, shade
from facerelight.bootstrap.surface import view_surface
from facerelight.evaluation.results import ScriptParser
from facerelight.geometry.alignment import CropFrame
from facerelight.geometry.lights import light_from_angles
from facerelight.photo.faces.face_mesh import fit_face_mesh
from facerelight.photo.faces.head_pose import HeadPose, canonical_face
from facerelight.photo.faces.landmarks import find_faces

FRAME = CropFrame(400, 360, 0.55)  # a head with some background
PITCH = 8.0  # heads look up by so much, as in the model's own renderings
SKIN = ((1.3, 0.92, 0.72), (1.18, 0.96, 0.83), (1.45, 0.88, 0.58))  # red, green, blue over luminance
FIT_SEED, TEST_SEED = 100, 7


class HeadPhoto(NamedTuple):
    """``photo (H, W, 3)`` uint8 sRGB; ``landmarks (3, 2)`` pixels; the ``pose``; ``upright (3, 3)``, the head's own."""

    photo: np.ndarray
    landmarks: np.ndarray
    pose: HeadPose
    upright: np.ndarray


def head_photos(
    seed: int,
    count: int,
    turn: float = 14.0,
    tilt: float = 0.0,
    scales: tuple[float, float] = (1.0, 1.0),
    pose: HeadPose | None = None,
) -> Iterator[HeadPhoto]:
    """Photographs of heads ``0 .. count - 1`` of a seed, each lit by one hard and two weaker lamps at random.

    Args:
        seed: of the people, their paint and their light.
        count: how many.
        turn: degrees, the largest random yaw; the pitch varies by 0.6 of it.
        tilt: degrees, the largest random roll.
        scales: range of the size; at 1 the eyes are 91 pixels apart.
        pose: yaw and pitch of everybody, instead of random ones.
    """
    source, domain, renderer = MakeHumanHeads(seed), Domain(fill=0.1), open_renderer(FRAME)
    middle = np.array(((FRAME.width - 1) / 2, (FRAME.height - 1) / 2))
    for index in range(count):
        rng = np.random.default_rng((seed, index, 7))
        look = replace(Look.random(rng, domain), style=SHORN)
        upright = source.head(index)
        yaw, pitch = rng.uniform(-turn, turn), PITCH + 0.6 * rng.uniform(-turn, turn)
        if pose is not None:
            yaw, pitch = pose.yaw, pose.pitch
        head = place_in_frame(rotate(upright, -yaw, -pitch), FRAME, upright.landmarks)
        surface = view_surface(renderer, head, look)
        side, height = rng.uniform(-60, 60), rng.uniform(-20, 50)
        image = np.zeros((FRAME.height, FRAME.width), np.float32)
        for azimuth, elevation, power in ((side, height, 1.0), (-side / 2, 20.0, 0.35), (0.0, 30.0, 0.25)):
            light = light_from_angles(float(azimuth), float(elevation))
            plan = plan_effects(surface, light, look.material)
            image += power * shade(surface, light, look.material, plan, renderer).numpy()
        inside = np.zeros(image.size, np.float32)
        inside[surface.pixel.numpy()] = 1
        photo = _colour(image, inside.reshape(image.shape), rng)
        roll, scale = rng.uniform(-tilt, tilt), np.exp(rng.uniform(*np.log(scales)))
        radians = np.deg2rad(roll)
        linear = scale * np.array(((np.cos(radians), -np.sin(radians)), (np.sin(radians), np.cos(radians))))
        size = int(1.25 * max(image.shape) * scale)
        shift = (size - 1) / 2 - linear @ middle
        wall = tuple(float(v) for v in photo[0, 0])
        way = cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR
        photo = cv2.warpAffine(photo, np.column_stack((linear, shift)), (size, size), flags=way, borderValue=wall)
        truth = (head.landmarks[:, :2] * (1, -1) + middle) @ linear.T + shift
        yield HeadPhoto(photo, truth, HeadPose(float(yaw), float(pitch), float(roll)), upright.landmarks)
    renderer.close()


def _colour(image: np.ndarray, inside: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Skin-coloured, before a plain wall, exposed and coded: uint8 sRGB."""
    level = float(np.percentile(image[inside > 0], 90))
    skin = image[..., None] / level * rng.uniform(0.3, 0.8) * SKIN[rng.integers(3)]
    wall = rng.uniform(0.05, 0.6) * rng.uniform(0.85, 1.15, 3)
    share = cv2.GaussianBlur(inside, (0, 0), 0.7)[..., None]
    linear = np.clip(skin * share + wall * (1 - share), 0, 1)
    coded = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    return (255 * coded).round().astype(np.uint8)


def measure(count: int) -> dict[str, float]:
    """Errors over ``count`` heads; distances in eye distances, angles in degrees."""
    distances, angles, missed, seconds = [], [], 0, 0.0
    for head in head_photos(TEST_SEED, count, tilt=30.0, scales=(0.35, 1.6)):
        start = time.perf_counter()
        faces = find_faces(head.photo)
        seconds += time.perf_counter() - start
        if not faces or faces[0].pose is None:
            missed += 1
            continue
        unit = np.hypot(*(head.landmarks[1] - head.landmarks[0]))
        distances.append(np.linalg.norm(faces[0].landmarks - head.landmarks, axis=1) / unit)
        angles.append(np.abs(np.subtract(faces[0].pose, head.pose)))
    report = {"heads": count, "missed": missed, "mean": np.mean(distances), "p95": np.percentile(distances, 95)}
    report |= dict(zip(("eye left", "eye right", "mouth"), np.mean(distances, 0), strict=True))
    for name, values in zip(HeadPose._fields, np.transpose(angles), strict=True):
        report |= {f"{name} degrees": values.mean(), f"{name} degrees p95": np.percentile(values, 95)}
    report["seconds a photo"] = seconds / count
    return {name: round(float(value), 4) for name, value in report.items()}


def measure_canonical(count: int) -> dict[str, np.ndarray]:
    """The rigid points that explain, least squares, the dense points of heads turned by known angles; symmetric."""
    mirror = canonical_face().mirror
    views, seen, landmarks = [], [], []
    for head in head_photos(FIT_SEED, count, turn=25.0):
        points = fit_face_mesh(head.photo, head.landmarks, mirror).points[:, :2]
        view = head.pose.rotation[:2] * ((1,), (-1,))
        own = head.upright @ view.T
        a, b = own - own.mean(0), head.landmarks - head.landmarks.mean(0)
        scale = (a * b).sum() / (a * a).sum()
        views.append(view)
        seen.append((points - head.landmarks.mean(0)) / scale + own.mean(0))
        landmarks.append(head.upright)
    flat = np.stack(seen, 1).reshape(468, -1).T  # (2 count, 468)
    points = np.linalg.lstsq(np.concatenate(views), flat, rcond=None)[0].T
    mean = np.mean(landmarks, 0)
    flip = (-1, 1, 1)
    return {
        "points": ((points + points[mirror] * flip) / 2).astype(np.float32),
        "landmarks": ((mean + mean[[1, 0, 2]] * flip) / 2).astype(np.float32),
        "mirror": mirror.astype(np.int16),
    }


def main() -> None:
    parser = ScriptParser(__file__, __doc__)
    parser.add_argument("--heads", type=int, default=200, help="how many heads are measured")
    parser.add_argument("--canonical", type=Path, help="measure the canonical face anew and write it to this .npz")
    parser.add_argument("--canonical-heads", type=int, default=80, help="how many heads it is measured on")
    parser.add_results("json")
    args = parser.parse_args()
    if args.canonical:
        np.savez_compressed(args.canonical, **measure_canonical(args.canonical_heads))
    report = measure(args.heads)
    print(json.dumps(report, indent=2))
    parser.save_report(args.json, report)


if __name__ == "__main__":
    main()
