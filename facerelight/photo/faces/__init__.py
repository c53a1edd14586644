"""The faces of a photograph: found, measured by dense points, their pose, eyes and mouth."""

from facerelight.photo.faces.landmarks import (
    Face,
    HeadPose,
    LandmarksNotFoundError,
    face_at,
    find_faces,
    find_landmarks,
)

__all__ = ["Face", "HeadPose", "LandmarksNotFoundError", "face_at", "find_faces", "find_landmarks"]
