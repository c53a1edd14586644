"""A second device for machines that have none: tensors that say they are elsewhere and refuse to meet those of the
CPU, as a GPU's do.

Inside ``with Elsewhere():`` the device "meta" holds numbers. ``tensor.to("meta")`` takes them there, ``.cpu()`` brings
them back; whatever mixes the two is a RuntimeError, except for single numbers and for indices, which torch lets pass.
"""

from __future__ import annotations

from typing import Any

import torch
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_flatten, tree_map

AWAY = torch.device("meta")
MAY_INDEX = {torch.ops.aten.index.Tensor, torch.ops.aten.index_put_.default, torch.ops.aten.index_put.default}


class Away(torch.Tensor):
    """A tensor on the second device; ``here`` holds its numbers."""

    here: torch.Tensor

    @staticmethod
    def __new__(cls, here: torch.Tensor) -> Away:
        away = torch.Tensor._make_wrapper_subclass(
            cls, here.shape, strides=here.stride(), storage_offset=here.storage_offset(), dtype=here.dtype, device=AWAY
        )
        away.here = here
        return away

    def __repr__(self) -> str:  # type: ignore[override]
        return f"Away({self.here})"

    def tolist(self) -> Any:
        return self.here.tolist()

    @classmethod
    def __torch_dispatch__(cls, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return run(function, args, kwargs or {})


class Elsewhere(TorchDispatchMode):
    """Makes factories on the second device give numbers."""

    def __torch_dispatch__(self, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return run(function, args, kwargs or {})


def run(function: Any, args: Any, kwargs: dict[str, Any]) -> Any:
    """``function`` on the numbers behind its tensors, if all are on one device."""
    tensors = [leaf for leaf in tree_flatten((args, kwargs))[0] if isinstance(leaf, torch.Tensor)]
    away = [tensor for tensor in tensors if isinstance(tensor, Away)]
    device = kwargs.get("device")
    moved = device is not None and torch.device(device) == AWAY
    copies = "_to_copy" in str(function) or "copy_" in str(function)
    if away and not copies:
        strangers = [t for t in tensors if not isinstance(t, Away) and t.dim()]
        if function in MAY_INDEX:
            strangers = [t for t in strangers if t.dtype not in (torch.long, torch.bool)]
        if strangers:
            raise RuntimeError(f"{function}: expected all tensors on the same device, got one on the CPU")
    if moved:
        kwargs = {**kwargs, "device": torch.device("cpu")}
    plain = tree_map(lambda leaf: leaf.here if isinstance(leaf, Away) else leaf, (args, kwargs))
    result = function(*plain[0], **plain[1])
    leaves = "_to_copy" in str(function) and device is not None and not moved
    stays = (moved or bool(away)) and not leaves
    known = {id(tensor.here): tensor for tensor in away}  # in-place operations give their tensor back

    def back(leaf: Any) -> Any:
        if not stays or not isinstance(leaf, torch.Tensor) or isinstance(leaf, Away):
            return leaf
        return known[id(leaf)] if id(leaf) in known else Away(leaf)

    return tree_map(back, result)
