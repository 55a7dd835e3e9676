"""Tasks on this machine: in this process, or in children, so many at a time.

A pool has slots(), how many tasks may run; submit(task), which returns a future; finished(futures),
which waits and yields (future, Result); and close(), which stops what is under way.
"""

import logging
import threading
import time
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from dataclasses import replace
from queue import SimpleQueue

from clsplat.distribute.child import in_child
from clsplat.distribute.task import DONE, FAILED, REFUSED, Result
from clsplat.errors import ClsplatError, Interrupted
from clsplat.io.lock import exclusive
from clsplat.training.interrupt import was_interrupted

HERE = "this machine"


class InProcess:
    """One task after the other in the main thread, which alone hears Ctrl-C."""

    def __init__(self, began, call):
        self._began, self._call = began, call

    def slots(self):
        return 1

    def submit(self, task):
        self._began(task.name)
        begin = time.monotonic()
        ending, message = self._ending(task)
        future = Future()
        future.set_result(Result(ending, message, time.monotonic() - begin, HERE))
        return future

    def _ending(self, task):
        try:
            with exclusive(task.folder):
                if not task.done.exists():
                    self._call(task)
        except Interrupted:
            raise
        except ClsplatError as error:
            return REFUSED, str(error)
        except Exception as error:  # noqa: BLE001  (the other tasks shall have their turn)
            if was_interrupted(error):
                raise KeyboardInterrupt from None
            logging.getLogger(__name__).exception("%s failed", task.name)
            return FAILED, f"{type(error).__name__}: {error}"
        if not task.done.exists():
            return FAILED, f"it ended well but did not write {task.done}"
        return DONE, ""

    def finished(self, futures):
        return [(future, future.result()) for future in futures]

    def close(self):
        pass


class Processes:
    """`workers` children at a time, the devices dealt out to them in turn."""

    def __init__(self, began, workers, devices, program):
        self._began, self._workers, self._program = began, workers, program
        self._threads = ThreadPoolExecutor(workers)
        self._stopping = threading.Event()
        self._free = SimpleQueue()
        for number in range(workers):
            self._free.put(devices[number % len(devices)] if devices else "")

    def slots(self):
        return self._workers

    def submit(self, task):
        return self._threads.submit(self._work, task)

    def _work(self, task):
        self._began(task.name)
        device = self._free.get()
        try:
            result = in_child(task, self._program, device, stopping=self._stopping.is_set)
            return replace(result, worker=f"{HERE}, device {device}" if device else HERE)
        finally:
            self._free.put(device)

    def finished(self, futures):
        done, _ = wait(futures, return_when=FIRST_COMPLETED)
        return [(future, future.result()) for future in done]

    def close(self):
        self._stopping.set()
        self._threads.shutdown(cancel_futures=True)
