"""The simulation of large scenes: nothing is lost, and what it counts is what happened."""

import json

import pytest

pytest.importorskip("distributed")
from tools.studies import simulate  # noqa: E402


@pytest.mark.slow
def test_no_block_is_lost_though_tries_fail_and_workers_die(tmp_path):
    simulate.main([str(tmp_path), "--photos", "100", "4000", "--workers", "4", "--seconds", "40",
                   "--scale", "1000", "--failures", "0.2", "--deaths", "0.1"])
    small, large = map(json.loads, (tmp_path / "simulation.jsonl").read_text().splitlines())
    assert (small["blocks"], large["blocks"]) == (1, 40)
    assert small["lost"] == large["lost"] == 0
    assert large["failed_tries"] > 0 and large["worker_deaths"] > 0
    assert large["tries"] == 40 + large["failed_tries"] + large["worker_deaths"]
    assert 40 <= large["block_seconds"] < 60 and large["bytes"] > 500
    assert large["overhead"] * large["block_seconds"] == pytest.approx(
        large["gap_seconds"] * large["tries"] / 40)
    table = (tmp_path / "simulation.md").read_text()
    assert "| 4,000 | 40 | 0 |" in table
