"""How a relit image is chosen from what is known of it; apart, so that a command line's help needs no torch."""

from typing import Literal, get_args

__all__ = ["RELIGHTING_METHODS", "Method"]

Method = Literal["expected", "map", "mle"]
"""The mean image (3.17, Algorithm 2), the most probable grey levels (Algorithm 1), or n fixed and unknown (3.19)."""
RELIGHTING_METHODS: tuple[Method, ...] = get_args(Method)
