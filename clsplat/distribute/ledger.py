"""Which tasks wait, how often each was tried, and what became of it."""

from collections import Counter, deque
from dataclasses import replace
from pathlib import Path

from clsplat.distribute.task import DONE, FAILED, REFUSED, Outcome
from clsplat.io.folders import make_folder

LOSSES = 10  # workers that may go away under a task: it is rarely to blame, but it can be


class Ledger:
    """tasks: of `run`, whose other arguments are the same. Those finished before have an Outcome of
    no tries at once, and no progress; the folders of the others are made."""

    def __init__(self, tasks, retries, progress, begun=None):
        self.tasks = [replace(task, done=Path(task.done).absolute()) for task in tasks]
        names = Counter(task.name for task in self.tasks)
        if len(names) < len(self.tasks):
            raise ValueError(f"two tasks are named {names.most_common(1)[0][0]}")
        self.retries, self.progress, self.begun = retries, progress, begun
        self.outcomes, self.waiting = {}, deque()
        self.tries, self.failures, self.losses, self.seconds = (Counter() for _ in range(4))
        for task in self.tasks:
            if task.done.exists():
                self.outcomes[task.name] = Outcome(task, True, 0.0, 0, "", "finished before")
                continue
            self.waiting.append(task)
            make_folder(task.folder)

    def began(self, name):
        """Some worker began a try of the task."""
        self.tries[name] += 1
        if self.begun:
            self.begun(name)

    def settle(self, task, result):
        """A try ended: the task is finished, has failed for good, or waits again."""
        name = task.name
        self.seconds[name] += result.seconds
        self.failures[name] += result.ending == FAILED
        self.losses[name] += result.ending not in (DONE, FAILED, REFUSED)
        if result.ending not in (DONE, REFUSED) and (
                self.failures[name] <= self.retries and self.losses[name] < LOSSES):
            self.waiting.append(task)
            return
        outcome = Outcome(task, result.ending == DONE, self.seconds[name], self.tries[name],
                          result.worker, result.message)
        self.outcomes[name] = outcome
        if self.progress:
            self.progress(outcome)

    def in_order(self):
        """The outcomes, in the order of the tasks."""
        return [self.outcomes[task.name] for task in self.tasks]
