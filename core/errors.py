"""The one error that reaches people."""


class SnergError(Exception):
    """One sentence saying what is wrong, where, and what to do about it.

    The command line prints it and exits with 2; an operator reports it and returns CANCELLED.
    """


class Cancelled(SnergError):
    """Work stopped because the person asked for it; what was finished before is kept."""
