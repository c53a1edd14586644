"""The bust in a photograph: where it is, its surface, and how light falls on it."""

from facerelight.photo.bust.matte import person_matte
from facerelight.photo.bust.shading import BustShading
from facerelight.photo.bust.surface import Bust, fit_bust, head_rotation, make_bust

__all__ = ["Bust", "BustShading", "fit_bust", "head_rotation", "make_bust", "person_matte"]
