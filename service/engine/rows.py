"""What the scheduler may know of a batch's rows; nothing here knows an array."""

from typing import Protocol, TypeVar, runtime_checkable

SelfT = TypeVar("SelfT")


@runtime_checkable
class Rows(Protocol):
    """Some samples of one request that stand at the same turn; its length is their number."""

    @property
    def request_id(self) -> int:
        """The request that they belong to."""

    @property
    def turns_left(self) -> int:
        """How many turns each of them takes at most until it is whole."""

    def __len__(self) -> int:
        """How many they are."""

    def split(self: SelfT, count: int) -> tuple[SelfT, SelfT]:
        """The first ``count`` of them, and the others."""


RowsT = TypeVar("RowsT", bound=Rows)
