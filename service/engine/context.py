"""What the graphs know of a row beside its noise."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from jaxtyping import Shaped

Tensors: TypeAlias = dict[str, Shaped[np.ndarray, "..."]]


@dataclass(kw_only=True, slots=True, eq=False)
class Context:
    """Tensors that a graph may ask for by name, each with a batch of one; rows may share it."""

    tensors: Tensors
    encoded: bool = False
    """Whether what the encoder gives is among them."""


def distinct(contexts: Iterable[Context]) -> list[Context]:
    """Each context once, in the order in which they first come."""
    return list({id(context): context for context in contexts}.values())


def gathered(names: Iterable[str], contexts: Sequence[Context]) -> Tensors:
    """One batch of the tensors that the contexts have of these names; row i is of context i."""
    shared = distinct(contexts)
    position = {id(context): i for i, context in enumerate(shared)}
    index = np.array([position[id(context)] for context in contexts])
    return {
        name: np.concatenate([context.tensors[name] for context in shared])[index]
        for name in names
        if name in shared[0].tensors
    }
