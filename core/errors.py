"""The one error that reaches people."""

import re
from collections.abc import Iterator
from contextlib import contextmanager

<<<<<<< HEAD
LONGEST = 1000  # characters of a message; names in files may have any length
# What could break a line, move the cursor or turn the text round: control characters, line separators, directions of writing.
CONTROL = re.compile("[\x00-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069]+")


def printable(text: str) -> str:
    """Text as one line for a terminal: without control characters."""
    return CONTROL.sub(" ", text)


def clean(text: str) -> str:
    """Text as one line of a length that people read: `printable`, without the middle where it is very long."""
    text = printable(text)
    return text if len(text) <= LONGEST else f"{text[: LONGEST * 2 // 3]} … {text[-LONGEST // 4 :]}"
=======
LONGEST = 1000  # characters of a sentence: names in files may be as long as the file
>>>>>>> readers


class SnergError(Exception):
    """One sentence saying what is wrong, where, and what to do about it; `clean`, whatever names it quotes.

    It is one line of printable characters, whatever names a file put into it, and at most LONGEST of them. The command line prints
    it and exits with 2; an operator reports it and returns CANCELLED.
    """

<<<<<<< HEAD
    def __init__(self, sentence: str) -> None:
        super().__init__(clean(sentence))
=======
    def __init__(self, sentence: str = "") -> None:
        super().__init__(one_line(sentence))
>>>>>>> readers


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
