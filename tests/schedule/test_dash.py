"""The schedule of DashGaussian: spectra, the resolution curve and the primitive curve."""

import dataclasses
import json

import numpy as np
import pytest

from clsplat.options import TrainOptions
from clsplat.schedule import registry
from clsplat.schedule.dash import Dash, cumulative_spectrum
from clsplat.schedule.plan import SceneFacts
from clsplat.schedule.steps import scaled_steps

OPTIONS = scaled_steps(TrainOptions(iterations=30000, schedule="dash", reset_every=3000))
SIZE, START = (192, 160), 1000


def a_photo(width=SIZE[0], height=SIZE[1], seed=0, slope=1.5):
    """uint8[3, H, W] of random phases, whose spectrum falls with frequency to the power -slope."""
    rng = np.random.default_rng(seed)
    fy, fx = np.meshgrid(np.fft.fftfreq(height), np.fft.fftfreq(width), indexing="ij")
    frequency = np.maximum(np.hypot(fx, fy), 1 / width)
    noise = np.fft.fft2(rng.normal(size=(3, height, width)))
    values = np.fft.ifft2(noise / frequency**slope).real
    values = 128 + 40 * values / values.std()
    return np.clip(values, 0, 255).astype(np.uint8)


PHOTOS = [a_photo(seed=seed, slope=slope) for seed, slope in enumerate((1.3, 1.1, 1.2))]


def scene_facts(photos=PHOTOS, size=SIZE, count=START):
    return SceneFacts(size, count, 1.0, photos=lambda: iter(photos), pixels=10**8)


def schedule_of(photos=PHOTOS, size=SIZE, **changes):
    return Dash(dataclasses.replace(OPTIONS, **changes), scene_facts(photos, size))


@pytest.fixture(scope="module")
def plans():
    """All plans of a run, asked once each."""
    schedule = schedule_of()
    return [schedule.plan(i) for i in range(1, OPTIONS.iterations + 1)]


def test_it_is_known_by_name_and_grows_the_highest():
    assert registry.schedule_of("dash") is Dash and Dash.fills_target
    assert OPTIONS.densify_until == 27000


@pytest.mark.parametrize("width, height", [(48, 40), (33, 17), (7, 40), (16, 16), (1, 1)])
def test_a_centred_window_of_the_spectrum(width, height):
    photo = a_photo(width, height)
    whole = np.fft.fftshift(np.abs(np.fft.fft2(photo.astype(float))), axes=(1, 2))
    spectrum = cumulative_spectrum(photo)
    y, x = np.indices((height, width))
    reach = np.maximum(np.abs(x - width // 2) / (width / 2), np.abs(y - height // 2) / (height / 2))
    for k in (0, 1, 42, 85, 100, 300, 512, 1000, 1024):
        expected = whole[:, reach <= k / 1024 + 1e-12].sum()
        assert abs(spectrum[k] - expected) < 1e-4 * spectrum[-1], f"{k} / 1024"


def sampled(photos):
    """The resolution curve by bisection on every window, as published: factors and starts."""
    spectra = [cumulative_spectrum(photo) for photo in photos]
    grid = np.arange(1025) / 1024

    def factor_at(spectrum, value):
        low, high = 1.0, 1e4
        for _ in range(64):
            middle = (low + high) / 2
            low, high = (middle, high) if np.interp(1 / middle, grid, spectrum) > value else (low, middle)
        return low

    r0 = min(min(8, factor_at(spectrum, spectrum[-1] / 4)) for spectrum in spectra)
    mean = np.mean(spectra, axis=0)
    energy = np.linspace(np.interp(1 / r0, grid, mean), mean[-1], 32)
    factors = [r0, *(factor_at(mean, e) for e in energy[1:31]), 1.0]
    starts = np.log(energy / energy[0]) / np.log(energy[31] / energy[0])
    return np.array(factors), 27000 * starts


def test_the_published_curve():
    schedule = schedule_of()
    factors, starts = sampled(PHOTOS)
    assert 2 < factors[0] < 7.9
    for start, factor in zip(starts[:-1], factors):
        assert abs(schedule.scale(start) - factor) < 1e-6 * factor
    halfway = (starts[5] + starts[6]) / 2
    mean = (factors[5] ** -2 + factors[6] ** -2) / 2
    assert abs(schedule.scale(halfway) ** -2 - mean) < 1e-9


def test_the_factor_is_whole_and_changes_at_rounds_of_growth_only(plans):
    levels = [plan.level for plan in plans]
    changed = [i for i in range(1, len(levels)) if levels[i] != levels[i - 1]]
    assert len(changed) > 1 and all(plans[i - 1].grows for i in changed)
    assert (np.diff(levels) <= 0).all() and levels[-1] == 1
    schedule = schedule_of()
    assert set(levels) <= set(schedule.levels) and levels[0] == schedule.levels[0]
    assert schedule.levels == tuple(sorted(schedule.levels, reverse=True))
    assert schedule.levels[-1] == 1
    for steps, plan in enumerate(plans[:-1]):
        if plan.grows:  # by statistics of images of the factor before
            assert plans[steps + 1].level == int(schedule.scale(steps + 1))


def test_rounds_and_resets(plans):
    rounds = [i + 1 for i, plan in enumerate(plans) if plan.grows]
    assert rounds == [i + 1 for i in range(600, 27000, 100)]
    assert [i + 1 for i, plan in enumerate(plans) if plan.resets_opacity] == [i + 1 for i in range(3000, 27000, 3000)]
    assert not any(plan.prunes_large for plan in plans)


def grown(schedule, above, keeps=1.0):
    """Counts after each round of growth, and the factors in use, if each round does as it may."""
    count, counts, factors = START, [], []
    for i in range(1, OPTIONS.iterations + 1):
        plan = schedule.plan(i)
        if plan.grows:
            left = int(count * keeps)
            count = schedule.target(i, left, above)
            assert left <= count <= 1.2 * left
            counts.append(count)
            factors.append(plan.level)
    return counts, factors


def test_the_target_follows_the_resolution():
    """P_init + 5 P_init / r^(2 - i / T), where nothing limits it."""
    schedule = schedule_of()
    for iteration in range(1, 26900):
        plan = schedule.plan(iteration)
        if plan.grows and (iteration - 1) % 3000 == 0:
            expected = START + 5 * START / plan.level ** (2 - (iteration - 1) / 27000)
            assert schedule.target(iteration, int(expected) - 1, 0) == int(expected)
    assert schedule.plan(26901).grows
    assert schedule.target(26901, 5900, 0) == 6 * START


def test_growth_never_falls_and_reaches_the_final_number():
    counts, factors = grown(schedule_of(), above=0)
    assert (np.diff(counts) >= 0).all() and counts[-1] == 6 * START
    assert factors[0] > 1 and len(counts) == 264


def test_the_last_interval_asks_for_all():
    schedule = schedule_of()
    schedule.plan(1)
    assert schedule.factor > 1
    assert schedule.target(26801, 10**5, 0) == 10**5  # never fewer
    assert schedule.target(26801, 5900, 0) == 5900 < schedule.target(26901, 5900, 0) == 6000
    assert schedule.target(26901, 2001, 0) == 2401  # a fifth more, rounded down


def test_the_final_number_follows_the_demand():
    """M = max(M, floor(0.98 M + min(1e6, above)))."""
    schedule = schedule_of()
    expected = 5 * START
    for above in (0, 50, 99, 101, 400, 3 * 10**6, 0, 7000):
        expected = max(expected, int(0.98 * expected + min(10**6, above)))
        schedule.target(601, START, np.int64(above))
        assert schedule.final_growth == expected
    assert expected > 10**6


@pytest.mark.slow
def test_a_resumed_schedule_goes_on_as_if_it_had_never_stopped():
    def go_on(schedule, begin, end):
        record = []
        for i in range(begin, end):
            plan = schedule.plan(i)
            record.append((plan, schedule.target(i, 2000, 150) if plan.grows else None))
        return record

    whole = schedule_of()
    for stop in (1, 900, 5001, 16002, 28000):
        whole = schedule_of()
        go_on(whole, 1, stop)
        resumed = schedule_of()
        resumed.load(json.loads(json.dumps(whole.state())))
        assert go_on(whole, stop, stop + 2000) == go_on(resumed, stop, stop + 2000)
