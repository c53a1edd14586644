"""The one luminance, and what counts as dark: each threshold with its reason. Needs no torch."""

__all__ = [
    "BLACK",
    "LARGEST_QUOTIENT",
    "LOGARITHM_FLOOR",
    "LUMINANCE",
    "MEASURED_FLOOR",
    "NOISE_FLOOR",
    "QUOTIENT_FLOOR",
    "RATIO_FLOOR",
    "SHADOW",
]

LUMINANCE = (0.2126, 0.7152, 0.0722)
"""Luminance of linear sRGB (Rec. 709)."""

BLACK = 1e-6
"""Radiance: an image without more holds no light at all, and its light is not asked for."""
NOISE_FLOOR = 2 / 255
"""Radiance: relative contrast below it is a camera's noise, not detail."""
MEASURED_FLOOR = 0.01
"""Radiance: quotients of images of faces, which are measured and not shown, level out below it."""
QUOTIENT_FLOOR = 0.05
"""Radiance: below it a quotient of average faces would only amplify noise."""
LARGEST_QUOTIENT = 4.0
"""Of two average faces, and its inverse the least: on the way to one light no pixel changes by more."""
RATIO_FLOOR = 0.02
"""Of a face's mean radiance, so that dark skin is not shade: below it ratios of two lights on one face level out."""
LOGARITHM_FLOOR = 0.003
"""Luminance: added before logarithms where errors are measured, so that black on black is no error."""
SHADOW = 20 / 255
"""Radiance: below it a pixel of an input counts as shadowed when errors inside shadows are measured."""
