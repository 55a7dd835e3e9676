"""What counts as time of training."""

from types import SimpleNamespace

import pytest

from clsplat.training import recorder


def test_time_of_a_pause_is_not_training_while_it_lasts_or_later(monkeypatch):
    """The last record of a block is written in a pause: the time since the pause before was counted
    twice there."""
    now = [100.0]
    monkeypatch.setattr(recorder.time, "perf_counter", lambda: now[0])
    clock = recorder.Clock(SimpleNamespace(build_seconds=0.0, finish=lambda: None))
    clock.restart()
    now[0] += 5
    with clock.paused():
        now[0] += 3
        assert clock.trained() == pytest.approx(5)
        assert clock.state() == pytest.approx({"train_seconds": 5, "wall_seconds": 8})
    now[0] += 2
    assert clock.trained() == pytest.approx(7)
