"""Questions to programs outside of Blender, such as another Python or a farm's Manager: asked once a session, answered in a thread."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

from ..core.errors import SnergError
from ..core.jobs.task import ThreadTask
from ..core.progress import Progress

State = Literal["asked", "ready", "unready", "absent"]
ICONS = {"asked": "SORTTIME", "ready": "CHECKMARK", "unready": "ERROR", "absent": "INFO"}  # Blender's names


@dataclass(frozen=True)
class Answer:
    """What is known of a program. text: a sentence for the artist. state: being asked, of use, there but of no use, or not there."""

    text: str
    state: State

    @property
    def icon(self) -> str:
        """Blender's name of the icon beside it."""
        return ICONS[self.state]


class Questions:
    """What is known of programs by their names, which are paths or addresses."""

    def __init__(
        self, asking: str, ask: Callable[[str, Progress], Answer], refused: State, check: Callable[[str], None] = lambda _: None
    ) -> None:
        """asking: the text until the answer has come. ask: called in a thread with a name, and a Progress to be called now and then, which
        raises Cancelled when nobody waits any more. check: called before it, in this thread. refused: the state where either of them
        raises SnergError.
        """
        self._asking, self._ask, self._refused, self._check = asking, ask, refused, check
        self._answers: dict[str, Answer] = {}
        self._tasks: dict[str, ThreadTask] = {}

    def answer(self, name: str) -> Answer:
        """What is known of a program; the first call of a session asks it."""
        if name not in self._answers:
            self._answers[name] = self._begin(name)
        return self._answers[name]

    def known(self, name: str) -> Answer | None:
        """What is known of a program, which is not asked."""
        return self._answers.get(name)

    def forget(self, name: str) -> None:
        """Ask the program again at the next call of `answer`, because it may have changed."""
        self._answers.pop(name, None)
        if task := self._tasks.pop(name, None):
            task.cancel()

    def poll(self) -> bool:
        """Read the answers that have come. Returns whether there are any."""
        ended = [name for name, task in self._tasks.items() if not task.poll()]
        for name in ended:
            task = self._tasks.pop(name)
            self._answers[name] = task.result["answer"] if task.state == "done" else Answer(task.error, self._refused)
        return bool(ended)

    def stop(self) -> None:
        """Forget every answer, and wait for none."""
        for name in list(self._answers):
            self.forget(name)

    def _begin(self, name: str) -> Answer:
        try:
            self._check(name)
        except SnergError as error:
            return Answer(str(error), self._refused)
        self._tasks[name] = ThreadTask(lambda progress: {"answer": self._ask(name, progress)})
        return Answer(self._asking.format(name), "asked")
