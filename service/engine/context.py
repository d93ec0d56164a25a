"""What the graphs know of rows beside their noise."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from threading import Lock
from typing import TypeAlias

import numpy as np
from jaxtyping import Shaped

Tensors: TypeAlias = dict[str, Shaped[np.ndarray, "..."]]


@dataclass(kw_only=True, slots=True, eq=False)
class Context:
    """Tensors that a graph may ask for by name: one batch entry that rows share, or one each."""

    tensors: Tensors
    encoded: bool = False
    """Whether what the encoder gives is among them."""
    lock: Lock = field(default_factory=Lock, repr=False)
    """Held by the thread that encodes it."""

    def __len__(self) -> int:
        """How many batch entries its tensors have."""
        return len(next(iter(self.tensors.values())))

    def part(self, rows: slice | Shaped[np.ndarray, "n"]) -> "Context":
        """The context of some of its rows; where they share one, that very one."""
        if len(self) == 1:
            return self
        tensors = {name: tensor[rows] for name, tensor in self.tensors.items()}
        return replace(self, tensors=tensors, lock=Lock())


Part: TypeAlias = tuple[Context, int]
"""A context, and how many successive rows of a batch it is that of."""


def unencoded(contexts: Iterable[Context]) -> list[Context]:
    """Those that lack what the encoder gives, each once, in the order in which they first come."""
    return list({id(context): context for context in contexts if not context.encoded}.values())


def gathered(names: Iterable[str], parts: Sequence[Part]) -> Tensors:
    """One batch of the tensors of these names that the contexts have, for all rows of all parts."""
    first, _ = parts[0]
    return {
        name: _batch([(context.tensors[name], count) for context, count in parts])
        for name in names
        if name in first.tensors
    }


def joined(parts: Sequence[Part]) -> Context:
    """The context of all rows of all parts, which are alike in what they have encoded."""
    first, _ = parts[0]
    return Context(tensors=gathered(first.tensors, parts), encoded=first.encoded)


def _batch(
    parts: Sequence[tuple[Shaped[np.ndarray, "..."], int]],
) -> Shaped[np.ndarray, "B ..."]:
    tensor, count = parts[0]
    if len(parts) == 1 and len(tensor) == count:
        return tensor
    batch = np.empty((sum(count for _, count in parts), *tensor.shape[1:]), tensor.dtype)
    start = 0
    for tensor, count in parts:
        batch[start : start + count] = tensor
        start += count
    return batch
