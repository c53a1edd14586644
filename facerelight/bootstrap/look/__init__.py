"""What people look like: skin, eyes, brows, lips and hair, all drawn at random; no photograph is involved."""

from facerelight.bootstrap.look.skin import Look, paint

__all__ = ["Look", "paint"]
