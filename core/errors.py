"""The one error that reaches people."""

from collections.abc import Iterator
from contextlib import contextmanager


class SnergError(Exception):
    """One sentence saying what is wrong, where, and what to do about it.

    The command line prints it and exits with 2; an operator reports it and returns CANCELLED.
    """


class Cancelled(SnergError):
    """Work stopped because the person asked for it; what was finished before is kept."""


@contextmanager
def needs_jax() -> Iterator[None]:
    """Turn a missing JAX into a sentence."""
    try:
        yield
    except ImportError as error:
        if "jax" not in str(error):
            raise
        raise SnergError("Training and baking need JAX, which is not installed in this Python: run 'pip install jax'.") from error
