"""The one error that reaches people."""

from collections.abc import Iterator
from contextlib import contextmanager

LONGEST = 1000  # characters of a sentence: names in files may be as long as the file


class SnergError(Exception):
    """One sentence saying what is wrong, where, and what to do about it.

    It is one line of printable characters, whatever names a file put into it, and at most LONGEST of them. The command line prints
    it and exits with 2; an operator reports it and returns CANCELLED.
    """

    def __init__(self, sentence: str = "") -> None:
        super().__init__(one_line(sentence))


class Cancelled(SnergError):
    """Work stopped because the person asked for it; what was finished before is kept."""


def one_line(text: str, longest: int = LONGEST) -> str:
    """`text` with its white space as single spaces, what cannot be printed written as \\x1b, and its middle left out where it is long."""
    if len(text) > longest:
        text = f"{text[: longest // 2]} ... {text[-(longest // 4) :]}"
    text = "".join(c if c.isprintable() else ascii(c)[1:-1] for c in " ".join(text.split()))
    return text if len(text) <= longest else f"{text[: longest // 2]} ... {text[-(longest // 4) :]}"


@contextmanager
def needs_jax() -> Iterator[None]:
    """Turn a missing JAX into a sentence."""
    try:
        yield
    except ImportError as error:
        if "jax" not in str(error):
            raise
        raise SnergError("Training and baking need JAX, which is not installed in this Python: run 'pip install jax'.") from error
