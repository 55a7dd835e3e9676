"""Which tasks wait, how often each was tried, and how it ended."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path

from clsplat.distribute.task import DONE, FAILED, REFUSED, Outcome, Result, Task
from clsplat.io.folders import make_folder

MOST_LOSSES = 10  # workers that may disappear while they run a task: it may be the cause


class Ledger:
    """The state of all tasks of one `run`, which has the same arguments.

    Tasks that were finished before get an Outcome without tries, which is not reported as progress.
    The folders of the other tasks are created.
    """

    def __init__(self, tasks: Iterable[Task], retries: int,
                 progress: Callable[[Outcome], object] | None,
                 began: Callable[[str], object] | None = None) -> None:
        self.tasks = [replace(task, done=Path(task.done).absolute()) for task in tasks]
        names = Counter(task.name for task in self.tasks)
        if len(names) < len(self.tasks):
            raise ValueError(f"two tasks are named {names.most_common(1)[0][0]}")
        self.retries, self._progress, self._began = retries, progress, began
        self.outcomes: dict[str, Outcome] = {}
        self.waiting: deque[Task] = deque()
        self.tries, self.failures, self.losses = (Counter[str]() for _ in range(3))
        self.seconds = {task.name: 0.0 for task in self.tasks}
        for task in self.tasks:
            if task.done.exists():
                self.outcomes[task.name] = Outcome(task, True, 0.0, 0, "", "finished before")
                continue
            self.waiting.append(task)
            make_folder(task.folder)

    def began(self, name: str) -> None:
        """Note that a worker began a try of the task."""
        self.tries[name] += 1
        if self._began:
            self._began(name)

    @property
    def can_begin(self) -> bool:
        """Whether a waiting task may begin."""
        return any(not self._awaited(task) for task in self.waiting)

    def next_task(self) -> Task | None:
        """Take the first of the waiting tasks that may begin; None if there is none."""
        task = next((task for task in self.waiting if not self._awaited(task)), None)
        if task:
            self.waiting.remove(task)
        return task

    def give_up(self) -> None:
        """Give the tasks that still wait an Outcome, which is not reported as progress."""
        for task in self.waiting:
            self.outcomes[task.name] = Outcome(
                task, False, 0.0, 0, "", f"it waits for {self._awaited(task)}")
        self.waiting.clear()

    def _awaited(self, task: Task) -> str:
        """The first task that must be finished before this one, and is not; "" if there is none."""
        return next((name for name in task.after
                     if name not in self.outcomes or not self.outcomes[name].ok), "")

    def settle(self, task: Task, result: Result) -> None:
        """Note the end of a try: the task is finished, has finally failed, or waits again."""
        name = task.name
        self.seconds[name] += result.seconds
        self.failures[name] += result.ending == FAILED
        self.losses[name] += result.ending not in (DONE, FAILED, REFUSED)
        if result.ending not in (DONE, REFUSED) and (
                self.failures[name] <= self.retries and self.losses[name] < MOST_LOSSES):
            self.waiting.append(task)
            return
        outcome = Outcome(task, result.ending == DONE, self.seconds[name], self.tries[name],
                          result.worker, result.message)
        self.outcomes[name] = outcome
        if self._progress:
            self._progress(outcome)

    def in_order(self) -> list[Outcome]:
        """The outcomes in the order of the tasks."""
        return [self.outcomes[task.name] for task in self.tasks]
