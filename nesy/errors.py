"""The one exception for mistakes of the caller."""


class UserError(ValueError):
    """A mistake of the caller's: bad input, a missing step, a damaged file.

    The message is one line for the person reading it: what was wrong, where, what would be right.
    The command line prints that line and exits with status 2; any other exception is a bug of ours.
    """
