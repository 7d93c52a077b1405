"""The one exception for mistakes of the caller."""

MOST_CHARACTERS = 1000
"""Longest message that is shown whole."""


class UserError(ValueError):
    """A mistake of the caller's: bad input, a missing step, a damaged file.

    The message is one line for the person reading it: what was wrong, where, what would be right.
    The command line prints that line and exits with status 2; any other exception is a bug of ours.
    """

    def __init__(self, message: str) -> None:
        super().__init__(shortened(message))


def shortened(message: str) -> str:
    """A message that quotes a file of a stranger's may be as long as the file: its beginning and end then."""
    return message if len(message) <= MOST_CHARACTERS else f"{message[:700]} [...] {message[-200:]}"
