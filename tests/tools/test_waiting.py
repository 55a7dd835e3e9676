"""The tables of tools/studies/waiting.py."""

from tools.studies.waiting import OURS, budget_table, race_table


def run(seconds, score):
    return {"process_seconds": seconds, "cc_psnr": score, "psnr": score - 1, "ssim": score / 100}


RESULTS = {
    (OURS, "a/one"): [run(2.0, 20.0), run(8.0, 30.0), run(9.0, 26.0)],
    (OURS, "two"): [run(5.0, 25.0)],
    ("peer", "a/one"): [run(1.0, 10.0), run(16.0, 28.0)],
    ("peer", "two"): [run(10.0, 25.5)],
}


def test_a_budget_has_the_best_training_that_ended_by_then():
    rows = budget_table(RESULTS, [OURS, "peer"], ["a/one", "two"], [1.5, 5.0, 9.0]).rows
    assert rows[:3] == [
        (OURS, "1.5", "0 of 2", "-", "-", "-"),
        (OURS, "5", "2 of 2", "22.50", "21.50", "0.2250"),
        (OURS, "9", "2 of 2", "27.50", "26.50", "0.2750"),
    ]
    assert rows[4][2:4] == ("1 of 2", "10.00")


def test_the_race_is_to_the_end_of_the_peers_last_training():
    assert race_table(RESULTS, [OURS, "peer"], ["a/one", "two"]).rows == [
        ("peer", "one", "28.00", "16.0", "8.0", "0.50"),
        ("peer", "two", "25.50", "10.0", "-", "-"),
    ]
