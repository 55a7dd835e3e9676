"""Calls in threads: results in order, few of them at a time, and errors in their turn."""

import threading

import pytest

from clsplat.io.ahead import called_ahead


def test_results_come_in_order_and_few_are_ahead():
    begun, last, gate = [], [], threading.Event()

    def arguments():
        for number in range(9):
            begun.append(number)
            yield number, 10 * number

    def call(number, tens):
        if number == 0:
            gate.wait(5)  # the first ends last
        last.append(number)
        if number == 2:
            gate.set()
        return number + tens

    for number, result in enumerate(called_ahead(call, arguments(), 2, 4)):
        assert result == 11 * number and len(begun) <= number + 4
    assert number == 8 and last.index(0) > last.index(2)


def test_an_error_is_raised_in_its_turn():
    def call(number):
        if number == 1:
            raise ValueError("the second")
        return number

    results = called_ahead(call, zip(range(50)), 1, 3)
    assert next(results) == 0
    with pytest.raises(ValueError, match="the second"):
        next(results)
