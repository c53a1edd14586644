"""Modules whose learned buffers take the shapes of the state that is loaded into them."""

from __future__ import annotations

from typing import Any

from torch import Tensor, nn

__all__ = ["LearnedModule"]


class LearnedModule(nn.Module):
    """A module with learned buffers: ``load_state_dict`` works into a fresh object as into a fitted one, whatever their
    sizes; it keeps its own dtype and device once it has learned."""

    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *rest: Any) -> None:
        for name, buffer in self._buffers.items():
            loaded = state_dict.get(prefix + name)
            if isinstance(loaded, Tensor) and (buffer is None or buffer.shape != loaded.shape):
                like = loaded if buffer is None or not buffer.numel() else buffer
                self._buffers[name] = loaded.new_empty(loaded.shape, dtype=like.dtype, device=like.device)
        super()._load_from_state_dict(state_dict, prefix, *rest)
