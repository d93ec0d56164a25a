"""What can be wrong with a motion file.

FormatError
├── UnsupportedFileError   a kind of file, or a feature of one, that is not read
├── TruncatedFileError     the file ends too early
├── MalformedFileError     something stands where something else must
├── ChannelCountError      a row has too many or too few values
├── InvalidNumberError     not a number, not finite, or out of any sensible range
└── EmptyMotionError       no frames
"""


class FormatError(ValueError):
    """A motion file that cannot be read: where, what was found there, what would be right."""

    def __init__(self, where: str, *, found: str, right: str) -> None:
        super().__init__(f"{where}: found {found}; {right}.")
        self.found = found
        self.right = right


class UnsupportedFileError(FormatError):
    """A kind of file, or a feature of one, that is not read."""


class TruncatedFileError(FormatError):
    """The file ends too early."""


class MalformedFileError(FormatError):
    """Something stands where something else must."""


class ChannelCountError(FormatError):
    """A row has too many or too few values."""


class InvalidNumberError(FormatError):
    """Not a number, not finite, or out of any sensible range."""


class EmptyMotionError(FormatError):
    """The file holds no frames."""
