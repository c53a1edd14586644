"""What is measured, and how: relighting on photographs with known lights, portraits against a ray-traced head."""

from facerelight.evaluation.relighting import (
    SOURCES,
    Scores,
    baseline_images,
    evaluate_folds,
    held_out_lights,
    relighting_errors,
)

__all__ = ["SOURCES", "Scores", "baseline_images", "evaluate_folds", "held_out_lights", "relighting_errors"]
