"""Calls in a few threads, ahead of the use of their results, of which few are in memory."""

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, TypeVar

Result = TypeVar("Result")


def called_ahead(
    call: Callable[..., Result], arguments: Iterable[tuple[Any, ...]], threads: int, most: int
) -> Iterator[Result]:
    """Yield the results of calls in order; an error of a call is raised in its turn.

    Parameters
    ----------
    call, arguments : what is called in one of the threads, and with what; taken in the caller's.
    threads : how many calls run at the same time.
    most : how many calls may be begun or done whose results were not yielded yet, at least 1.
    """
    with ThreadPoolExecutor(threads) as pool:
        ahead = deque[Future[Result]]()
        try:
            for each in arguments:
                ahead.append(pool.submit(call, *each))
                if len(ahead) >= most:
                    yield ahead.popleft().result()
            while ahead:
                yield ahead.popleft().result()
        finally:
            pool.shutdown(cancel_futures=True)
