"""The errors that are reported to users."""

import re
from collections.abc import Iterator
from contextlib import contextmanager

EXIT_ERROR = 2  # exit code of a command that refuses its input
EXIT_STOPPED = 130  # of a command that was stopped from the keyboard, by the convention of shells
MAX_MESSAGE = 1000  # characters of a message; the names that it quotes may have any length
# Characters that break a line, move the cursor or change the writing direction.
CONTROL = re.compile("[\x00-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069]+")


def printable(text: str) -> str:
    """Text as one line for a terminal: without control characters; other unprintable characters are escaped, such as \\udc80."""
    return "".join(c if c.isprintable() else ascii(c)[1:-1] for c in CONTROL.sub(" ", text))


def clean(text: str, longest: int = MAX_MESSAGE) -> str:
    """Text as one line for a message: `printable`, with the middle left out beyond `longest` characters."""
    return _shortened(printable(_shortened(text, longest)), longest)  # shortened first: the text may be as long as a file


def _shortened(text: str, longest: int) -> str:
    return text if len(text) <= longest else f"{text[: longest * 2 // 3]} … {text[-longest // 4 :]}"


class SnergError(Exception):
    """An error for users: one sentence that says what is wrong, where, and what to do about it.

    The text is passed through `clean`, as it may quote names from files. The command line prints it and exits with 2; an operator
    reports it and returns CANCELLED.
    """

    def __init__(self, sentence: str = "") -> None:
        super().__init__(clean(sentence))


class Cancelled(SnergError):
    """The user stopped the work. Results that were finished before are kept."""


@contextmanager
def needs_jax() -> Iterator[None]:
    """Raise a SnergError that says what to install, in place of the ImportError for a missing JAX or optax."""
    try:
        yield
    except ImportError as error:
        if "optax" in str(error):
            raise SnergError("Baking needs optax, which is not installed in this Python: run 'pip install optax'.") from error
        if "jax" not in str(error):
            raise
        raise SnergError("Training and baking need JAX, which is not installed in this Python: run 'pip install jax'.") from error
