"""Views that a reader leaves out, since one bad picture, pose or lens must not make the whole dataset unreadable."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager

from ..errors import SnergError

MOST_NAMED = 8  # views left out of which each has a note of its own; of more, the rest are counted


class UnusableView(SnergError):
    """One view of a dataset cannot be used; the others can."""


class UnsupportedLens(UnusableView):
    """One camera has a lens that is not supported; the others of its dataset can still be read."""


@contextmanager
def about_one_view() -> Iterator[None]:
    """Raise each SnergError, Cancelled not included, as UnusableView: what goes wrong inside concerns one view alone."""
    try:
        yield
    except SnergError as error:
        if type(error) is not SnergError:
            raise
        raise UnusableView(str(error)) from error


class LeftOut:
    """The views that are left out while a dataset is read."""

    def __init__(self) -> None:
        self.errors: list[UnusableView] = []  # a view each, in the order of reading

    @contextmanager
    def reading(self) -> Iterator[None]:
        """Leave out the view that is read inside where it raises UnusableView. Other errors pass."""
        try:
            yield
        except UnusableView as error:
            self.errors.append(error)

    def notes(self) -> tuple[str, ...]:
        """A sentence for each view that was left out; one for all beyond MOST_NAMED."""
        named = [f"{_clause(error)}; this image is left out." for error in self.errors[:MOST_NAMED]]
        rest = len(self.errors) - len(named)
        return (*named, f"{rest} more images are left out for such reasons.") if rest else tuple(named)

    def check(self, kept: Sequence[object]) -> None:
        """Raise the first error when no view is kept: it then concerns them all."""
        if self.errors and not kept:
            raise self.errors[0]


def _clause(error: SnergError) -> str:
    return str(error).removesuffix(".")
