"""Galleries on disk: one safetensors file, whose header says who is enrolled and what the templates belong to."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file

from facerelight.model.file import replacing
from facerelight.recognition.gallery.recognizer import Template

__all__ = ["load_templates", "save_templates"]

FORMAT, VERSION = "facerelight-gallery", 5
PARTS = {"recognizer": str, "key": dict, "owners": list}


def save_templates(path: Path, header: dict[str, object], templates: Template) -> None:
    """Write templates under a ``header`` of "recognizer", "key" and "owners"; an old file is replaced only once the new
    one is whole."""
    path.parent.mkdir(parents=True, exist_ok=True)
    told = json.dumps({"format": FORMAT, "version": VERSION, **header})
    with replacing(path) as partial:
        save_file({part: values.contiguous() for part, values in templates.items()}, partial, {"gallery": told})


def load_templates(path: Path) -> tuple[dict[str, Any], Template]:
    """The header and the templates of a gallery.

    Raises:
        ValueError: a file that is missing, damaged or of another version.
    """
    try:
        with safe_open(path, "pt") as file:
            told = (file.metadata() or {}).get("gallery")
            if told is None:
                raise ValueError("a file without a gallery's header, as those of earlier versions were")
            header = json.loads(told)
            templates = {part: file.get_tensor(part) for part in file.keys()}  # noqa: SIM118 - no mapping
        if header["format"] != FORMAT or header["version"] != VERSION:
            raise ValueError(f"expected version {VERSION}, got {header.get('version')}")
        for part, kind in PARTS.items():
            if not isinstance(header[part], kind):
                raise ValueError(f"expected {part} as {kind.__name__}, got {header[part]!r}")
        _check(header["owners"], templates)
    except (OSError, KeyError, TypeError, ValueError, AttributeError, SafetensorError) as error:
        reason = getattr(error, "strerror", None) or error
        raise ValueError(
            f"{path}: expected a gallery, got {reason}; enroll anew with `facerelight recognize`"
        ) from error
    return header, templates


def _check(owners: list[object], templates: Template) -> None:
    if not all(isinstance(owner, str) and owner for owner in owners):
        raise ValueError("expected a name for every template, got others")
    if owners and "probe" not in templates:
        raise ValueError(f"expected templates with a probe, got {', '.join(templates) or 'none'}")
    for part, values in templates.items():
        if not values.is_floating_point() or len(values) != len(owners) or not torch.isfinite(values).all():
            raise ValueError(f"expected {len(owners)} finite {part}s, got {values.dtype} {tuple(values.shape)}")
